"""A task as training plays it, as a Gymnasium environment: for a loop of one's own around a trained agent."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.suite import TaskSuite


class TaskAsTrained(gymnasium.Env[npt.NDArray[Any], Any]):
    """One copy of a task with everything that training does to it, so that what a network sees is what it learned on.

    That is the suite's preprocessing (Atari: grey frames of 84x84, frame skip, sticky actions), channels first, zeros
    where this task is smaller than the suite's others, and stacked frames. Rewards are raw. No limit is added to the
    task's own: ``evaluation.max_episode_steps`` is the evaluation's.

    An observation is ``[k*c, H, W]`` or ``[k*features]`` (``suite.observation_shape``), as ``Agent.act`` takes it, and
    an action is a number that ``Agent.act`` gives. Where the task has fewer actions than the network has outputs, the
    others are refused; ``info["action_mask"]`` of ``reset`` and ``step`` says which it has, as Gymnasium's spaces take
    it: ``env.action_space.sample(info["action_mask"])``.
    """

    def __init__(self, suite: TaskSuite, task: str | int) -> None:
        """Make the environment.

        Args:
            suite: of an agent (``agent.suite``), or from ``switchmt_snn.tasks.registry.make_suite``.
            task: name or index.

        Raises:
            TaskError: the suite has no such task, or it cannot be made.
        """
        self._suite, self._task = suite, suite.index(task)
        self._play = Play(suite, self._task, 1)
        first, count = suite.first_action(self._task), suite.num_actions
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(count, start=first)
        self._action_mask = suite.valid_actions_KA[self._task].astype(np.int8)
        dtype: Any = suite.frame_dtype
        is_image = np.dtype(dtype) == np.uint8
        low, high = (0, 255) if is_image else (-np.inf, np.inf)
        space: gymnasium.Space[Any] = gymnasium.spaces.Box(low, high, shape=suite.observation_shape, dtype=dtype)
        self.observation_space = space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Start an episode: its first observation, and an info with the ``action_mask``.

        Args:
            seed: of this episode, which is a function of it and of its actions; and, as in Gymnasium, of the seeds of
                the episodes that follow. None draws the next one.
            options: none are known.
        """
        super().reset(seed=seed)
        episode = int(self.np_random.integers(2**31)) if seed is None else seed
        self._play.begin(np.zeros(1, np.int64), np.asarray([episode], np.int64))
        return self._play.observations[0].copy(), self._info()

    def step(self, action: int) -> tuple[npt.NDArray[Any], float, bool, bool, dict[str, Any]]:
        """One agent step: observation, raw reward, terminated, truncated, and an info with the ``action_mask``.

        Raises:
            TaskError: no such action in this task, or no episode runs.
        """
        index = int(action) - self._suite.first_action(self._task)
        name = self._suite.names[self._task]
        if not 0 <= index < self._suite.num_actions or not self._suite.valid_actions_KA[self._task, index]:
            valid = np.flatnonzero(self._suite.valid_actions_KA[self._task]) + self._suite.first_action(self._task)
            raise TaskError(f"the action is {action!r}, expected one of task {name!r}: {valid.tolist()}")
        if self._play.over[0]:
            raise TaskError(f"no episode of task {name!r} runs, expected reset() before this step")
        result = self._play.step(np.asarray([index], np.int64))
        ended = bool(result.terminated[0]), bool(result.truncated[0])
        return self._play.observations[0].copy(), float(result.rewards[0]), *ended, self._info()

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self._action_mask.copy()}

    def close(self) -> None:
        """Free the environment."""
        self._play.close()
