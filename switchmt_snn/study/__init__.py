"""Many runs: a grid of trials, the processes that train them, their statistics and their report."""
