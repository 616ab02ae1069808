"""A suite: several tasks with one frame shape and one action count, so that one network serves them all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import TaskError, did_you_mean

Frames = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
"""Frames of n environments: ``[n, c, H, W]`` images or ``[n, features]`` vectors."""


@dataclass(frozen=True)
class VectorStep:
    """What one step of n environments returned; rewards are raw."""

    frames: Frames
    rewards: npt.NDArray[np.float64]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]

    @property
    def ended(self) -> npt.NDArray[np.int64]:
        """Copies whose episode ended, terminated or truncated."""
        return np.flatnonzero(self.terminated | self.truncated)


class TaskEnvironment(Protocol):
    """``num_envs`` copies of one task.

    After ``reset(env_ids, seeds)`` a copy is a function of its seed and the actions that follow, whatever came before:
    exact resume rests on it. A copy whose episode ended must be reset before its frames mean anything again.
    """

    num_envs: int

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes in some copies; returns their first frames ``[len(env_ids), ...]``."""

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step all copies."""

    def close(self) -> None:
        """Free the copies."""


@dataclass(frozen=True)
class Reference:
    """Published raw scores of a task, for normalising: ``(score - random) / (human - random)``."""

    random: float
    human: float
    source: str


@dataclass(frozen=True)
class TaskSuite:
    """Tasks in order, and what they share.

    Attributes:
        names: task names; the index in this tuple is the task index everywhere.
        frame_shape: one frame, channels first: ``(c, H, W)`` or ``(features,)``.
        frame_dtype: uint8 or float32.
        frame_stack: frames per observation.
        scale: factor to the network's input range.
        in_unit_range: whether scaled frames lie in [0, 1].
        action_names: one per action of the shared action space.
        valid_actions_KA: which actions exist in which task.
        references: published scores, where there are any.
    """

    names: tuple[str, ...]
    frame_shape: tuple[int, ...]
    frame_dtype: npt.DTypeLike
    frame_stack: int
    scale: float
    in_unit_range: bool
    action_names: tuple[str, ...]
    valid_actions_KA: npt.NDArray[np.bool_]
    references: dict[str, Reference]
    make: Callable[[int, int], TaskEnvironment]
    """``make(task, num_envs)`` builds the environments of a task."""

    @property
    def num_actions(self) -> int:
        """Number of actions A of the shared action space."""
        return len(self.action_names)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The stacked observation: ``(k*c, H, W)`` or ``(k*features,)``."""
        return (self.frame_stack * self.frame_shape[0], *self.frame_shape[1:])

    def index(self, name: str) -> int:
        """Index of a task by name.

        Raises:
            TaskError: the suite has no such task.
        """
        if name not in self.names:
            raise TaskError(f"unknown task {name!r}{did_you_mean(name, self.names)}")
        return self.names.index(name)
