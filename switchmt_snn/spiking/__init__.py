"""The spiking Q-network: tensors in, tensors out; knows nothing of games, buffers or files."""
