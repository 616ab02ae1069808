"""Comparison of exported files with the trained network, spike by spike."""
