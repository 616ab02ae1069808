"""Learning: joins tasks and network; Algorithm 1, replay, switching, checkpoints, evaluation."""
