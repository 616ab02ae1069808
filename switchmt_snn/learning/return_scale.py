"""How large a task's returns are, so that TD errors of several tasks can be measured alike.

The error is scaled and not the reward (as in Schaul et al. 2021, arXiv 2105.05347), so Q-values, scores and exports
stay in the task's own rewards.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import ExperimentConfig, clips_rewards
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.state import Stateful


class ReturnScale(Stateful):
    """Root mean square, over all steps of a task, of the discounted return so far: ``R_t = r_t + discount R_(t-1)``.

    Every copy of the task has its own R, which starts at 0 with each episode. The square keeps the mean in, so returns
    that are all alike have a scale, too; their variance would be near 0.
    """

    SAVED = ("running_L", "sum_of_squares", "count")
    DERIVED = ("discount", "clip_rewards")

    def __init__(self, num_copies: int, discount: float, clip_rewards: bool) -> None:
        self.discount, self.clip_rewards = discount, clip_rewards
        self.running_L: npt.NDArray[Any] = np.zeros(num_copies)
        self.sum_of_squares = 0.0
        self.count = 0

    def add(self, rewards_L: npt.NDArray[np.float64], over_L: npt.NDArray[np.bool_]) -> None:
        """Take in one step of every copy.

        Args:
            rewards_L: raw rewards.
            over_L: where a return ends with this step, terminated or truncated.
        """
        rewards_L = rewards_L.clip(-1.0, 1.0) if self.clip_rewards else rewards_L
        running_L = rewards_L + self.discount * self.running_L
        self.sum_of_squares += float(np.square(running_L).sum())
        self.count += len(running_L)
        self.running_L = np.where(over_L, 0.0, running_L)

    def end(self) -> None:
        """The running returns of all copies end here."""
        self.running_L = np.zeros_like(self.running_L)

    @property
    def value(self) -> float:
        """The scale; 1 while no reward was seen."""
        return math.sqrt(self.sum_of_squares / self.count) if self.sum_of_squares > 0.0 else 1.0


def make_return_scales(config: ExperimentConfig, num_tasks: int) -> list[ReturnScale]:
    """One for each task; none without ``learning.return_normalization``."""
    learning = config.learning
    if learning.return_normalization == "none":
        return []
    if learning.return_normalization == "per_task":
        scale = (config.tasks.num_envs, learning.discount, clips_rewards(config))
        return [ReturnScale(*scale) for _ in range(num_tasks)]
    raise ConfigError(f"learning.return_normalization is {learning.return_normalization!r}, expected none or per_task")
