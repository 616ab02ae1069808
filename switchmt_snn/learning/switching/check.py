"""Whether a switching criterion from outside the package keeps the contract of ``Criterion``; also for authors."""

from __future__ import annotations

import torch

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.bounds import SwitchingPolicy
from switchmt_snn.learning.switching.criterion import EpisodeRecord

EPISODES = 6
"""Episodes of each of the two visits that a policy is played for."""


def check_policy(config: SwitchingConfig) -> None:
    """Make the policy that a config names, and play it through two short visits of made-up episodes.

    Checked: the constructor and its options, that nothing in it fails, what it returns and measures, and that a
    checkpoint can hold its state. A run makes a policy of its own.

    Args:
        config: the settings under ``switching``, with a policy that is resolved.

    Raises:
        ConfigError: naming the class, what was seen, and what was expected.
    """
    policy = SwitchingPolicy(config, num_tasks=2)
    policy.state_dict()
    for task in range(2):
        for episode in range(1, EPISODES + 1):
            theta = torch.full((4,), 1.0 / (task * EPISODES + episode))
            record = EpisodeRecord(task, episode, 10 * episode, episode, episode, float(episode % 4), theta.clone)
            policy.end_of_episode(record)
            policy.state_dict()
        policy.leave(task)
        policy.start_visit()
        policy.state_dict()
