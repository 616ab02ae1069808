"""Replay memory: one ring per task, every frame stored once."""
