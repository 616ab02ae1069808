"""Whether a switching criterion from outside the package keeps the contract of ``Criterion``; also for authors."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.bounds import SwitchingPolicy
from switchmt_snn.learning.switching.criterion import EpisodeRecord
from switchmt_snn.tasks.suite import Reference

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
    tasks = max(2, len(config.reference_scores), len(config.floor_scores))
    policy = SwitchingPolicy(config, tasks, [Reference(random=0.0, human=1.0, source="made up")] * tasks)
    policy.state_dict()
    for task in range(2):
        for episode in range(1, EPISODES + 1):
            theta = torch.full((4,), 1.0 / (task * EPISODES + episode))
            record = EpisodeRecord(
                task=task,
                episodes_in_visit=episode,
                steps_in_visit=10 * episode,
                updates=episode,
                updates_in_visit=episode,
                episode_return=float(episode % 4),
                parameters=theta.clone,
                observations=lambda count: torch.zeros(count, 4),
                values=partial(_values, float(theta[0])),
                silent_shares=partial(_silent_shares, float(theta[0])),
            )
            policy.end_of_episode(record)
            policy.state_dict()
        policy.leave(task, 10 * EPISODES)
        policy.start_visit()
        policy.state_dict()


def _values(value: float, observations: Tensor) -> Tensor:
    return torch.full((len(observations), 2), value)


def _silent_shares(share: float, observations: Tensor) -> dict[str, float]:
    return {"value": share}
