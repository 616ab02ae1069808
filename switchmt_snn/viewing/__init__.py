"""Seeing a run: progress, health, tables. Nothing here is imported by learning."""
