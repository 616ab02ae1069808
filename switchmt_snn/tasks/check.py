"""Whether a suite's environments do what the suite says; for authors of suites, and used by the tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import TasksConfig
from switchmt_snn.config.plugins import failure, is_plugin
from switchmt_snn.errors import SwitchMTError, TaskError
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import Frames, TaskSuite, VectorStep

METHODS = {
    "reset": "reset(env_ids, seeds) -> frames; of a Gymnasium environment, reset(seed=...) -> (observation, info)",
    "step": "step(actions) -> VectorStep; of a Gymnasium environment, step(action) -> (observation, reward, "
    "terminated, truncated, info)",
    "close": "close()",
}
"""What environments must have, in words."""

STEPS_BEFORE_TRAINING = 20
"""Steps per task for which tasks from outside are played before a run starts."""


def check_before_training(config: TasksConfig, tasks: TaskSuite) -> None:
    """Play tasks from outside the package for a few steps: a suite as ``check_suite`` does, Gymnasium's once.

    Args:
        config: names the suite.
        tasks: what ``make_suite(config)`` returned.

    Raises:
        TaskError: naming the task, what was seen, and what was expected.
    """
    if is_plugin(config.suite):
        check_suite(tasks, STEPS_BEFORE_TRAINING)
    elif config.suite == "gym":
        checked = replace(tasks, make=lambda task, num_envs: _Checked(tasks, task, num_envs))
        for task in range(len(tasks.names)):
            _played(checked, task, STEPS_BEFORE_TRAINING)


def check_suite(tasks: TaskSuite, steps: int = 200) -> None:
    """Play every task at random in two copies, twice, and compare the play with the suite's facts.

    Checked: the environments have ``num_envs`` and every method; rewards and ends have a value per copy; shape and
    dtype of frames; the range of scaled frames; every valid action is taken; and an episode is the same again for the
    same seed and the same actions, which exact resume needs.

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
        self._tasks, self._name = tasks, tasks.names[task]
        with self._code("make", "make(task, num_envs) -> the copies of a task"):
            self._environment = tasks.make(task, num_envs)
        seen = f"task {self._name!r} is played by {type(self._environment).__name__}, which has"
        for method, expected in METHODS.items():
            if not callable(getattr(self._environment, method, None)):
                raise TaskError(f"{seen} no {method}, expected {expected}")
        count = getattr(self._environment, "num_envs", None)
        if count != num_envs:
            raise TaskError(f"{seen} num_envs {count!r}, expected the {num_envs} that make was asked for")

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        with self._code("reset", METHODS["reset"]):
            frames = self._environment.reset(env_ids, seeds)
        self._require_frames(frames, len(env_ids))
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        with self._code("step", METHODS["step"]):
            result = self._environment.step(actions)
        if not isinstance(result, VectorStep):
            raise TaskError(f"task {self._name!r} gave a {type(result).__name__} from step, expected a VectorStep")
        self._require_frames(result.frames, self.num_envs)
        for name, kinds in (("rewards", "fiu"), ("terminated", "b"), ("truncated", "b")):
            values = getattr(result, name)
            if np.shape(values) != (self.num_envs,) or np.asarray(values).dtype.kind not in kinds:
                raise TaskError(
                    f"task {self._name!r} gave {name} = {values!r}, expected an array of {self.num_envs} "
                    f"{'truth values' if kinds == 'b' else 'numbers'}, one for each copy"
                )
        if not np.isfinite(result.rewards).all():
            raise TaskError(f"task {self._name!r} gave the rewards {result.rewards}, expected finite ones")
        return result

    def close(self) -> None:
        self._environment.close()

    @contextmanager
    def _code(self, where: str, expected: str) -> Iterator[None]:
        """Around a call of code from outside: what it raises becomes one line."""
        try:
            yield
        except SwitchMTError:
            raise
        except Exception as error:
            raise TaskError(f"task {self._name!r} fails in {where} ({failure(error)}), expected {expected}") from error

    def _require_frames(self, frames: Frames, count: int) -> None:
        if not isinstance(frames, np.ndarray):
            raise TaskError(f"task {self._name!r} gave a {type(frames).__name__} as frames, expected an array")
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
