"""Spikes and synaptic operations, counted exactly."""
