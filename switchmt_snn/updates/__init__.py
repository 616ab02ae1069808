"""How an update is executed: eager, compiled, native, as a CUDA graph, by several processes."""
