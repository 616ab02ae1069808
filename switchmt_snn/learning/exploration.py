"""Which copies act at random, and how: epsilon-greedy, with random actions that may last."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from switchmt_snn.learning.state import Stateful

EXPONENT = 2.0
"""Of the zeta distribution of durations: n steps have probability proportional to n to the minus 2."""


class Exploration(Stateful):
    """Epsilon-greedy; temporally extended where a longest is above 1, as in Dabney et al. 2021 (arXiv 2006.01782).

    A copy that begins to explore, which happens with probability epsilon, keeps one random action for a number of steps
    drawn from a zeta distribution. Held actions reach what independent ones do not: in Enduro, 5,200 steps of random
    play gave no reward, and 16 with durations of up to 100 steps.

    Attributes:
        left_KN: steps that a random action still lasts, by task and copy; a task that is left keeps them.
        actions_KN: the random actions.
    """

    SAVED: ClassVar[tuple[str, ...]] = ("left_KN", "actions_KN")
    DERIVED: ClassVar[tuple[str, ...]] = ("longest_K_steps",)

    def __init__(self, longest_K_steps: Sequence[int], num_envs: int) -> None:
        """Nothing is held yet.

        Args:
            longest_K_steps: of each task, how long a random action lasts at most.
            num_envs: copies of a task, N.
        """
        self.longest_K_steps = tuple(longest_K_steps)
        num_tasks = len(self.longest_K_steps)
        self.left_KN = np.zeros((num_tasks, num_envs), np.int64)
        self.actions_KN = np.zeros((num_tasks, num_envs), np.int64)

    def choose(
        self, task: int, valid: npt.NDArray[np.int64], epsilon: float, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
        """Which copies explore ``[N]``, and their actions ``[N]``; the draws are the same whatever the network says.

        Args:
            task: index.
            valid: the task's actions.
            epsilon: probability of exploring, or where actions last, of beginning to explore.
            rng: source of the draws.
        """
        num_envs = self.left_KN.shape[1]
        begins = rng.random(num_envs) < epsilon
        actions = valid[rng.integers(0, len(valid), num_envs)]
        longest_steps = self.longest_K_steps[task]
        if longest_steps == 1:
            return begins, actions
        durations = np.minimum(rng.zipf(EXPONENT, num_envs), longest_steps)
        left, kept = self.left_KN[task], self.actions_KN[task]
        begins &= left == 0
        left[begins], kept[begins] = durations[begins], actions[begins]
        explores = left > 0
        left[explores] -= 1
        return explores, kept.copy()

    def end(self, task: int, env: int) -> None:
        """A copy's episode has ended, and with it what it held."""
        self.left_KN[task, env] = 0
