"""Speed and size, measured: ``python -m benchmarks.NAME [--json]`` prints a table, or JSON with the environment."""
