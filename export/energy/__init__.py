"""Energy: counts priced by published constants."""
