"""Runs: planned, driven, saved in a run folder."""
