"""Tasks: environments that share one observation shape and one action count; knows nothing of networks."""
