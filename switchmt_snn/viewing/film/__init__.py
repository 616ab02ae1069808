"""Films of play: the game beside the network's spikes, Q-values and gains, one frame per decision."""
