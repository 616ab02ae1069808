"""Trained networks that act: agents and their evaluation."""
