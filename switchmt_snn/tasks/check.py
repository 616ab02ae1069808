"""Whether a suite's environments do what the suite says; for authors of suites, and used by the tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import Frames, TaskSuite, VectorStep


def check_suite(tasks: TaskSuite, steps: int = 200) -> None:
    """Play every task at random in two copies, twice, and compare the play with the suite's facts.

    Checked: shape and dtype of frames, the range of scaled frames, every valid action is taken, and an episode is the
    same again for the same seed and the same actions, which exact resume needs.

    Args:
        tasks: what ``make_suite(config)`` returned.
        steps: steps per task.

    Raises:
        TaskError: naming the task, what was seen, and what was expected.
    """
    checked = replace(tasks, make=lambda task, num_envs: _Checked(tasks, task, num_envs))
    for task, name in enumerate(tasks.names):
        first, second = (_played(checked, task, steps) for _ in range(2))
        for step, (one, two) in enumerate(zip(first, second, strict=True)):
            if not all(np.array_equal(a, b) for a, b in zip(one, two, strict=True)):
                raise TaskError(
                    f"task {name!r} differs at step {step} when it is played again, expected the same frames, rewards "
                    "and ends for the same seed and actions; take every random number from reset's seed"
                )


class _Checked:
    """A task's environments; every frame and reward that they return is compared with the suite's facts."""

    def __init__(self, tasks: TaskSuite, task: int, num_envs: int) -> None:
        self.num_envs = num_envs
        self._tasks, self._name, self._environment = tasks, tasks.names[task], tasks.make(task, num_envs)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        frames = self._environment.reset(env_ids, seeds)
        self._require_frames(frames, len(env_ids))
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        result = self._environment.step(actions)
        self._require_frames(result.frames, self.num_envs)
        if not np.isfinite(result.rewards).all():
            raise TaskError(f"task {self._name!r} gave the rewards {result.rewards}, expected finite ones")
        return result

    def close(self) -> None:
        self._environment.close()

    def _require_frames(self, frames: Frames, count: int) -> None:
        tasks, shape = self._tasks, (count, *self._tasks.frame_shape)
        dtype = np.dtype(tasks.frame_dtype)
        if (frames.shape, frames.dtype) != (shape, dtype):
            raise TaskError(
                f"task {self._name!r} gave frames of shape {frames.shape} and type {frames.dtype}, expected {shape} "
                f"and {dtype}, as the suite says"
            )
        scaled = frames.astype(np.float32) * tasks.scale
        if not np.isfinite(scaled).all() or (tasks.in_unit_range and (scaled.min() < 0 or scaled.max() > 1)):
            wanted = "values from 0 to 1" if tasks.in_unit_range else "finite values"
            raise TaskError(
                f"task {self._name!r} gave scaled frames from {scaled.min():g} to {scaled.max():g}, expected {wanted}; "
                "change scale or in_unit_range"
            )


def _played(tasks: TaskSuite, task: int, steps: int) -> list[tuple[npt.NDArray[np.generic], ...]]:
    """First frames, then observations, rewards and ends of every step of two copies."""
    rng, valid, episodes = np.random.default_rng(0), np.flatnonzero(tasks.valid_actions_KA[task]), 2
    play = Play(tasks, task, 2)
    try:
        start = play.begin(np.arange(2), np.asarray([episode_seed(0, task, episode) for episode in range(2)]))
        journal: list[tuple[npt.NDArray[np.generic], ...]] = [(start.copy(),)]
        for step in range(steps):
            # Every valid action once, then random ones.
            actions = valid[[step, step]] if step < len(valid) else rng.choice(valid, 2)
            result = play.step(actions)
            journal.append((play.observations.copy(), result.rewards, result.terminated, result.truncated))
            for env in result.ended:
                play.begin(np.asarray([env]), np.asarray([episode_seed(0, task, episodes)]))
                episodes += 1
        return journal
    finally:
        play.close()
