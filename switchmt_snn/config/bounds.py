"""The largest values that settings take, in one place: far above any use, below what a machine or a library breaks at.

A value within them may still be refused by what follows: the memory that a run needs, a rule between two settings.
"""

from __future__ import annotations

LARGEST_WHOLE = 2**63 - 1
"""Of whole numbers: 64 bits, as NumPy, PyTorch and files hold them."""
LARGEST_FLOAT = 3.4e38
"""Of numbers: float32."""
LONGEST_TEXT = 200
"""Characters of a text."""
LONGEST_LIST = 256
"""Entries of a list."""

LARGEST: dict[str, float] = {
    "total_steps": 10**15,
    "threads": 1_024,
    "tasks.num_envs": 4_096,
    "tasks.frame_stack": 64,
    "tasks.frame_skip": 1_000,
    "tasks.noop_max": 10_000,
    "tasks.max_episode_frames": 10**9,
    "network.hidden_units": 65_536,
    "network.timesteps": 4_096,
    "network.quantiles": 1_024,
    "network.dendritic_segments": 1_024,
    "network.k_winners": 65_536,
    "learning.batch_size": 1_048_576,
    "learning.n_steps": 10_000,
    "learning.replay_capacity_steps": 10**9,
    "learning.learning_starts_steps": 10**9,
    "learning.replay_max_gib": 10**6,
    "learning.updates_per_round": 10**6,
    "learning.reestimate_statistics_batches": 10**6,
    "switching.window_episodes": 10**6,
    "switching.plateau_window_episodes": 10**6,
    "switching.probe_observations": 4_096,
    "switching.score_episodes": 10**6,
    "evaluation.episodes": 10**6,
    "evaluation.num_envs": 4_096,
    "evaluation.max_episode_steps": 10**9,
    "recording.keep_checkpoints": 10**6,
}
"""By key: bounds that are lower than those of the type. Steps and periods of steps have ``MOST_STEPS``."""
MOST_STEPS = 10**15
"""Of settings that count steps, episodes or updates."""


def largest(key: str, kind: type) -> float:
    """The largest value of a number's size that a setting takes.

    Args:
        key: as ``learning.batch_size``.
        kind: int or float.
    """
    if key in LARGEST:
        return LARGEST[key]
    counts = key.endswith(("_steps", "_episodes", "_updates", "_batches"))
    return MOST_STEPS if kind is int and counts else LARGEST_WHOLE if kind is int else LARGEST_FLOAT
