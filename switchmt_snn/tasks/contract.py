"""What environments return, compared with what their suite declares: at every reset and every step of every play."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np
import numpy.typing as npt

from switchmt_snn.config.plugins import user_code
from switchmt_snn.errors import TaskError, shown
from switchmt_snn.tasks.suite import Frames, Picture, TaskSuite, VectorStep

METHODS = {
    "make": "make(task, num_envs) -> the copies of a task",
    "reset": "reset(env_ids, seeds) -> frames",
    "step": "step(actions) -> VectorStep",
    "close": "close()",
    "picture": "picture(env_id) -> uint8 [H, W, 3] or None",
}
"""What a suite's environments must have, in words; ``picture`` is for those that can be drawn."""

GYMNASIUM_METHODS = {
    "reset": "reset(*, seed=None, options=None) -> (observation, info)",
    "step": "step(action) -> (observation, reward, terminated, truncated, info)",
    "close": "close()",
    "picture": 'render() -> uint8 [H, W, 3] with render_mode "rgb_array"',
}
"""The same of a Gymnasium environment."""

LARGEST_REWARD = float(np.finfo(np.float32).max)
"""Replay memories hold rewards as float32."""


def task_code(name: str, where: str, methods: dict[str, str] = METHODS) -> AbstractContextManager[None]:
    """Around a call of an environment's own code: what it raises becomes one line.

    Args:
        name: of the task.
        where: the method, one of ``methods``.
        methods: what is expected of each, in words.
    """
    return user_code(f"task {name!r} fails in {where}", methods[where], TaskError)


def gymnasium_code(name: str, where: str) -> AbstractContextManager[None]:
    """As ``task_code``, around a Gymnasium environment, whose methods have other arguments than a suite's."""
    return task_code(name, where, GYMNASIUM_METHODS)


class CheckedEnvironment:
    """A task's environments (a ``TaskEnvironment``); what they return is what the suite says, or a ``TaskError``.

    Checked: ``num_envs`` and the methods; shape, dtype and range of frames; rewards that are finite; a value per copy.
    An exception in the environment's own code becomes one line, too.
    """

    def __init__(self, tasks: TaskSuite, task: int, num_envs: int) -> None:
        """Make the environments.

        Raises:
            TaskError: they cannot be made, or lack ``num_envs`` or a method.
        """
        self.num_envs = num_envs
        self._tasks, self._name = tasks, tasks.names[task]
        self._dtype = np.dtype(tasks.frame_dtype)
        with task_code(self._name, "make"):
            self._environment = tasks.make(task, num_envs)
        seen = f"task {self._name!r} is played by {type(self._environment).__name__}, which has"
        for method in ("reset", "step", "close"):
            if not callable(getattr(self._environment, method, None)):
                raise TaskError(f"{seen} no {method}, expected {METHODS[method]}")
        count = getattr(self._environment, "num_envs", None)
        if count != num_envs:
            raise TaskError(f"{seen} num_envs {count!r}, expected the {num_envs} that make was asked for")

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes in some copies.

        Raises:
            TaskError: the environment fails, or its frames are not what the suite says.
        """
        with task_code(self._name, "reset"):
            frames = self._environment.reset(env_ids, seeds)
        self._require_frames(frames, len(env_ids))
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step all copies.

        Raises:
            TaskError: the environment fails, or what it returns is not what the suite says.
        """
        with task_code(self._name, "step"):
            result = self._environment.step(actions)
        if not isinstance(result, VectorStep):
            raise TaskError(f"task {self._name!r} gave a {type(result).__name__} from step, expected a VectorStep")
        self._require_frames(result.frames, self.num_envs)
        for name, kinds in (("rewards", "fiu"), ("terminated", "b"), ("truncated", "b"), ("lives_lost", "b")):
            values = getattr(result, name)
            if name == "lives_lost" and values is None:
                continue
            if np.shape(values) != (self.num_envs,) or np.asarray(values).dtype.kind not in kinds:
                raise TaskError(
                    f"task {self._name!r} gave {name} = {shown(values)}, expected an array of {self.num_envs} "
                    f"{'truth values' if kinds == 'b' else 'numbers'}, one for each copy"
                )
        if not (np.abs(result.rewards) <= LARGEST_REWARD).all():
            raise TaskError(
                f"task {self._name!r} gave the rewards {shown(np.asarray(result.rewards).tolist())}, expected "
                "finite numbers (float32); mend the environment's reward"
            )
        return result

    def picture(self, env_id: int) -> Picture | None:
        """A copy as people see the game ``[H, W, 3]``; None if there is no picture.

        Raises:
            TaskError: the environment's drawing fails, or gives something else.
        """
        draw = getattr(self._environment, "picture", None)
        if draw is None:
            return None
        with task_code(self._name, "picture"):
            picture = draw(env_id)
        if picture is None:
            return None
        if not (isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape[2:] == (3,)):
            shape, kind = getattr(picture, "shape", None), getattr(picture, "dtype", type(picture).__name__)
            raise TaskError(
                f"task {self._name!r} gave a picture of shape {shape} and type {kind}, expected uint8 [H, W, 3]"
            )
        return picture

    def close(self) -> None:
        """Free the copies."""
        with task_code(self._name, "close"):
            self._environment.close()

    def _require_frames(self, frames: Frames, count: int) -> None:
        if not isinstance(frames, np.ndarray):
            raise TaskError(f"task {self._name!r} gave a {type(frames).__name__} as frames, expected an array")
        tasks, shape = self._tasks, (count, *self._tasks.frame_shape)
        if frames.shape != shape or frames.dtype != self._dtype:
            raise TaskError(
                f"task {self._name!r} gave frames of shape {frames.shape} and type {frames.dtype}, expected {shape} "
                f"and {self._dtype}, as the suite says"
            )
        if self._dtype == np.uint8 and (not tasks.in_unit_range or 255 * tasks.scale <= 1):
            return
        low, high = float(frames.min()) * tasks.scale, float(frames.max()) * tasks.scale  # NaN if one value is
        if not (np.isfinite(low) and np.isfinite(high)):
            raise TaskError(
                f"task {self._name!r} gave observations from {low:g} to {high:g}, expected finite numbers (float32); "
                "mend the environment's observation"
            )
        if tasks.in_unit_range and (low < 0 or high > 1):
            raise TaskError(
                f"task {self._name!r} gave scaled frames from {low:g} to {high:g}, expected values from 0 to 1; change "
                "scale or in_unit_range"
            )
