"""Chips: their limits, and which of them hold a network."""
