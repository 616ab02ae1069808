"""What a suite of tasks is: ``Suite`` states its facts, ``TaskSuite`` is what it makes from a config.

The tasks of a ``TaskSuite`` share one frame shape and one action count, so that one network serves them all.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from switchmt_snn.config import SuiteDefaults, TasksConfig
from switchmt_snn.config.plugins import plugin_name
from switchmt_snn.errors import TaskError, did_you_mean

Frames = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
"""Frames of n environments: ``[n, c, H, W]`` images or ``[n, features]`` vectors."""


@dataclass(frozen=True)
class VectorStep:
    """What one step of n environments returned; rewards are raw.

    Attributes:
        lives_lost: copies that lost a life in this step; None if the task has no lives. Only
            ``learning.life_loss_is_terminal`` reads it.
    """

    frames: Frames
    rewards: npt.NDArray[np.float64]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    lives_lost: npt.NDArray[np.bool_] | None = None

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


Picture = npt.NDArray[np.uint8]
"""A picture of a game: red, green, blue ``[H, W, 3]``."""


class PicturedEnvironment(TaskEnvironment, Protocol):
    """As ``TaskEnvironment``, and every copy can be drawn; drawing changes nothing that is played."""

    def picture(self, env_id: int) -> Picture | None:
        """A copy as people see the game, in its present state; None if the game draws nothing."""


@dataclass(frozen=True)
class Reference:
    """Published raw scores of a task, for normalised scores."""

    random: float
    human: float
    source: str

    def normalized(self, score: float) -> float:
        """``(score - random) / (human - random)``: 0 for random play, 1 for the human."""
        return (score - self.random) / (self.human - self.random)


@dataclass(frozen=True)
class Later:
    """What tasks become midway.

    Attributes:
        from_steps: agent steps of the run after which they are so.
        tasks: under the names, with the outputs and frames of the earlier ones.
        changed: indices of those that are another task than before.
    """

    from_steps: int
    tasks: TaskSuite
    changed: tuple[int, ...]


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
        first_actions: by task, the number by which its environment calls action 0 (``start`` of a ``Discrete`` space);
            empty means 0 in every task. ``make``'s environments take actions from 0; ``Agent.act`` and exports name the
            environment's.
        thread_safe: whether copies may be stepped in several threads at a time; evaluations then use every core.
        versioned: whether the suite's ``packages``, ``files`` and this package hold all code that decides an episode.
            Random play is then kept beside a run and not played again. Default: no.
        make_pictured: as ``make``, of environments that can be drawn: the same play for the same seeds and actions.
            None if there are no pictures.
        later: what the tasks become midway (``tasks.later_names``); a suite's ``make`` leaves it None.
    """

    names: tuple[str, ...]
    frame_shape: tuple[int, ...]
    frame_dtype: npt.DTypeLike
    frame_stack: int
    scale: float
    in_unit_range: bool
    action_names: tuple[str, ...]
    valid_actions_KA: npt.NDArray[np.bool_]
    make: Callable[[int, int], TaskEnvironment]
    references: dict[str, Reference] = field(default_factory=dict)
    """``make(task, num_envs)`` builds the environments of a task."""
    first_actions: tuple[int, ...] = ()
    thread_safe: bool = False
    versioned: bool = False
    make_pictured: Callable[[int, int], PicturedEnvironment] | None = None
    later: Later | None = None

    def pictured(self) -> TaskSuite:
        """These tasks in environments that can be drawn (``Play.picture``), as far as they have pictures."""
        return self if self.make_pictured is None else replace(self, make=self.make_pictured)

    def at(self, step: int) -> TaskSuite:
        """The tasks as they are after so many agent steps of a run."""
        return self.later.tasks if self.later is not None and step >= self.later.from_steps else self

    def first_action(self, task: int) -> int:
        """The number by which a task's environment calls action 0."""
        return self.first_actions[task] if self.first_actions else 0

    @property
    def num_actions(self) -> int:
        """Number of actions A of the shared action space."""
        return len(self.action_names)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The stacked observation: ``(k*c, H, W)`` or ``(k*features,)``."""
        return (self.frame_stack * self.frame_shape[0], *self.frame_shape[1:])

    def index(self, task: str | int) -> int:
        """Index of a task that is given by name or by index.

        Raises:
            TaskError: the suite has no such task.
        """
        if isinstance(task, str):
            if task not in self.names:
                raise TaskError(f"unknown task {task!r}{did_you_mean(task, self.names)}")
            return self.names.index(task)
        if not isinstance(task, (int, np.integer)) or not 0 <= task < len(self.names):
            raise TaskError(f"task is {task!r}, expected a name or an index from 0 to {len(self.names) - 1}")
        return int(task)


@dataclass(frozen=True)
class PublishedScores:
    """Published raw scores of one policy, for reference rows under an evaluation.

    Attributes:
        policy: name of the row, as ``human (Wang 2016)``.
        source: where the scores were published.
        scores: mean raw score by task.
    """

    policy: str
    source: str
    scores: dict[str, float]


class Suite:
    """A family of tasks: every fact that the program states about them, and how to make them.

    A subclass states ``name``, ``defaults`` and ``examples`` and implements ``make``; everything else has a
    default. It must be at the top level of a module, because a run stores it as ``package.module:Name``.

    Attributes:
        name: short name, a value of ``tasks.suite`` once the suite is registered.
        defaults: frame stack, trunk and clipping of rewards where a config leaves them open.
        examples: tasks that can be learned together; tests and ``doctor`` use them.
        open_names: whether there are tasks that ``known_tasks`` does not list; else an unknown one is refused.
        packages: distributions whose versions a run stores.
        frames_per_s: emulator frames per second of real time; None if the tasks have no clock.
        steps_to_learn: training for fewer agent steps teaches nothing, and a short run says so; None says nothing.
        process_bytes: memory that the modules and the emulators of the suite take, for the estimate of a run.
        masks_actions: whether ``make`` follows ``tasks.minimal_action_mask``; else that setting is refused.
        takes_wrappers: whether ``make`` follows ``tasks.wrappers``, ``image_layout`` and ``subprocesses``; else they
            are refused.
        references: random and human scores by task, for normalised scores.
        published: rows that are printed under an evaluation.
        config: the tasks that a config asks for.
    """

    name: ClassVar[str]
    defaults: ClassVar[SuiteDefaults]
    examples: ClassVar[tuple[str, ...]]
    open_names: ClassVar[bool] = False
    packages: ClassVar[tuple[str, ...]] = ()
    frames_per_s: ClassVar[float | None] = None
    steps_to_learn: ClassVar[int | None] = None
    process_bytes: ClassVar[int] = 0
    masks_actions: ClassVar[bool] = False
    takes_wrappers: ClassVar[bool] = False
    references: ClassVar[dict[str, Reference]] = {}
    published: ClassVar[tuple[PublishedScores, ...]] = ()

    def __init__(self, config: TasksConfig) -> None:
        self.config = config

    def make(self) -> TaskSuite:
        """Make the tasks of the config; ``switchmt_snn.tasks.registry.make_suite`` calls it with known names.

        Raises:
            TaskError: a task cannot be made, or does not fit a Q-network.
            MissingExtraError: an optional package is needed.
        """
        raise NotImplementedError(
            f"{type(self).__name__} defines no make, expected make(self) -> TaskSuite; see "
            "docs/extending.md, Task and suite"
        )

    @classmethod
    def known_tasks(cls) -> tuple[str, ...]:
        """Names of the tasks; a suite with ``open_names`` lists those that it finds."""
        return cls.examples

    @property
    def frame_skip(self) -> int:
        """Emulator frames per agent step."""
        return 1

    @property
    def decisions_per_s(self) -> float | None:
        """Agent steps per second of real time; None if the tasks have no clock."""
        return None if self.frames_per_s is None else self.frames_per_s / self.frame_skip

    @property
    def tasks_with_lives(self) -> tuple[str, ...]:
        """Tasks of the config whose ``VectorStep`` names lost lives."""
        return ()

    @property
    def protocol(self) -> tuple[str, ...]:
        """Conditions of play that a score depends on, in words, as ``sticky actions 0.25``."""
        return ()

    @property
    def registered(self) -> dict[str, str]:
        """What decides how tasks are made and stands in no file, config or package's version, by name. Here nothing."""
        return {}

    @property
    def files(self) -> dict[str, Path]:
        """Files that decide what is learned, by a short name: a run stores their SHA-256. Here the suite's module."""
        suite = type(self)
        if suite.__module__.startswith("switchmt_snn."):
            return {}
        module, _, _ = plugin_name(suite, "tasks.suite").partition(":")
        return {module: Path(inspect.getfile(suite))}
