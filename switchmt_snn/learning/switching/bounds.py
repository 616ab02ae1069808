"""The switching policy: a criterion within the bounds that all policies keep (``min_stay_*``, ``max_stay_steps``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import ConfigError, shown
from switchmt_snn.learning.state import Stateful, require_storable
from switchmt_snn.learning.switching.criterion import (
    EpisodeRecord,
    Verdict,
    check_state,
    criterion_code,
    make_criterion,
)
from switchmt_snn.tasks.suite import Reference


@dataclass(frozen=True)
class Stay:
    """Stay on the task; the rest as in ``Verdict``."""

    reason: str
    measured: dict[str, float]
    summary: str = ""


@dataclass(frozen=True)
class SwitchTo:
    """Leave for another task; the rest as in ``Verdict``."""

    task: int
    reason: str
    measured: dict[str, float]


class SwitchingPolicy(Stateful):
    """A criterion within bounds: never leaves before the minimal stay, always by the maximal one.

    The next task is ``(i + 1) mod |E|``, unless the criterion chooses another one (``Criterion.next_task``).

    Examples:
        >>> import torch
        >>> policy = SwitchingPolicy(SwitchingConfig(policy="fixed_episodes", visit_episodes=1), num_tasks=2)
        >>> seen = {"task": 0, "episodes_in_visit": 1, "steps_in_visit": 9, "updates": 0, "updates_in_visit": 0}
        >>> record = EpisodeRecord(**seen, episode_return=1.0, parameters=lambda: torch.ones(3))
        >>> policy.end_of_episode(record).task
        1
    """

    SAVED = ("criterion",)
    DERIVED = ("config", "num_tasks")

    def __init__(
        self, config: SwitchingConfig, num_tasks: int, references: Sequence[Reference | None] | None = None
    ) -> None:
        """Make the criterion that the config names.

        Args:
            config: resolved.
            num_tasks: number of tasks K.
            references: published scores of each task; None if no task has any.

        Raises:
            ConfigError: the policy is not resolved, unknown, or no criterion (``make_criterion``), or it lacks what it
                needs to know of the tasks.
        """
        self.config = config
        self.num_tasks = num_tasks
        self.criterion = make_criterion(config)
        with criterion_code(config.policy, "meet_tasks"):
            self.criterion.meet_tasks(num_tasks, tuple(references or [None] * num_tasks))
        check_state(self.criterion)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the numbers that its decisions report."""
        return self.criterion.columns

    def end_of_episode(self, record: EpisodeRecord) -> Stay | SwitchTo:
        """Decide at the end of the only episode that ended in a step; a switch makes the criterion forget the visit.

        Raises:
            ConfigError: see ``judge``.
        """
        decision = self.judge(record)
        if isinstance(decision, SwitchTo):
            self.start_visit()
        return decision

    def judge(self, record: EpisodeRecord, left: bool = False) -> Stay | SwitchTo:
        """Decide at an episode's end. After a step in which a task was left, ``start_visit`` is due.

        Args:
            record: of the episode. Those that end in one step are judged in the order of their copies.
            left: whether an earlier episode ended the visit (in a training: one of the same step). The criterion then
                sees this one, too, and what it measures is reported; nothing more is decided.

        Raises:
            ConfigError: the criterion reports a number that it does not declare in ``columns``, or asks for parameters
                although it declares no ``snapshots``; one from outside the package fails, or returns no ``Verdict``.
        """
        if self._must_wait(record):
            if left:
                return Stay("visit_over", {})
            if self.must_leave(record.steps_in_visit):
                return self.leave(record.task, record.steps_in_visit)
            return Stay("no_updates_yet", {}, "no update yet")
        if self.criterion.snapshots(self.config) == 0:
            record = replace(record, parameters=self._undeclared_snapshot)
        with criterion_code(self.config.policy, "end_of_episode"):
            verdict = self.criterion.end_of_episode(record)
        measured = self._checked(verdict)
        if left:
            return Stay("visit_over", measured)
        if self.must_leave(record.steps_in_visit):
            return self._next(record, "max_stay_steps", measured)
        if not verdict.leave:
            return Stay(verdict.reason, measured, verdict.summary)
        if self.num_tasks == 1:
            return Stay("only_task", measured, verdict.summary)
        too_soon = (
            record.steps_in_visit < self.config.min_stay_steps
            or record.episodes_in_visit < self.config.min_stay_episodes
        )
        if too_soon:
            return Stay("min_stay", measured, verdict.summary)
        return self._next(record, verdict.reason, measured)

    def _must_wait(self, record: EpisodeRecord) -> bool:
        """Whether there is nothing to judge yet: the visit has had no update from the task's own replay."""
        judges = self.criterion.judges_learning and self.config.judge_learning != "always"
        return judges and record.updates_in_visit == 0

    def must_leave(self, steps_in_visit: int) -> bool:
        """Whether the visit has lasted ``max_stay_steps``; asked at every step, also within an episode."""
        limit = self.config.max_stay_steps
        return limit is not None and self.num_tasks > 1 and steps_in_visit >= limit

    def leave(self, task: int, steps_in_visit: int) -> SwitchTo:
        """The switch that ``must_leave`` demands within an episode; ``start_visit`` is due after it."""
        return SwitchTo(self._next_task(task, steps_in_visit), "max_stay_steps", {})

    def start_visit(self) -> None:
        """H_i <- []: the criterion forgets the visit that is over."""
        with criterion_code(self.config.policy, "start_visit"):
            self.criterion.start_visit()

    def state_dict(self) -> dict[str, Any]:
        """The criterion's state.

        Raises:
            ConfigError: the criterion has an attribute that a resume would lose, or that a checkpoint cannot hold.
        """
        check_state(self.criterion)
        state = super().state_dict()
        for name, value in state["criterion"].items():
            require_storable(value, f"{type(self.criterion).__name__}.{name}")
        return state

    def _next(self, record: EpisodeRecord, reason: str, measured: dict[str, float]) -> SwitchTo:
        return SwitchTo(self._next_task(record.task, record.steps_in_visit), reason, measured)

    def _next_task(self, task: int, steps_in_visit: int) -> int:
        """i <- (i + 1) mod |E|, or the criterion's choice."""
        with criterion_code(self.config.policy, "next_task"):
            chosen: Any = self.criterion.next_task(task, self.num_tasks, steps_in_visit)
        if type(chosen) is not int or not 0 <= chosen < self.num_tasks or chosen == task:
            raise ConfigError(
                f"criterion {type(self.criterion).__name__} returned {shown(chosen)} from next_task, expected the "
                f"index of another task than {task}, from 0 to {self.num_tasks - 1}"
            )
        return chosen

    def _checked(self, verdict: Verdict) -> dict[str, float]:
        """The measured numbers, each of which has a column."""
        name = type(self.criterion).__name__
        if not isinstance(verdict, Verdict):
            raise ConfigError(
                f"criterion {name} returned {shown(verdict)} from end_of_episode, expected "
                "Verdict(leave, reason, measured)"
            )
        if not (
            isinstance(verdict.leave, (bool, np.bool_))
            and isinstance(verdict.reason, str)
            and isinstance(verdict.measured, dict)
        ):
            raise ConfigError(
                f"criterion {name} returned {shown(verdict)}, expected leave True or False, reason a text, and "
                "measured a dict"
            )
        for name in verdict.measured:
            if name not in self.columns:
                raise ConfigError(
                    f"criterion {type(self.criterion).__name__} measured {name!r}, expected one of its columns "
                    f"({', '.join(self.columns) or 'none'}); add {name!r} to {type(self.criterion).__name__}.columns"
                )
        return {name: self._number(name, value) for name, value in verdict.measured.items()}

    def _number(self, column: str, value: Any) -> float:
        """A measured value as a float; the criteria of this package may measure NaN, of a network that diverged."""
        try:
            number = math.nan if isinstance(value, str) else float(value)
        except (TypeError, ValueError, RuntimeError):
            number = math.nan
        if math.isnan(number) and (is_plugin(self.config.policy) or not isinstance(value, float)):
            raise ConfigError(
                f"criterion {type(self.criterion).__name__} measured {column!r} as {shown(value)}, expected a number; "
                "leave it out of measured while it has none"
            )
        return number

    def _undeclared_snapshot(self) -> Tensor:
        name = type(self.criterion).__name__
        raise ConfigError(
            f"criterion {name} asks for the parameters but declares 0 snapshots, expected at least 1; define "
            f"{name}.snapshots(config), so that the memory estimate counts them"
        )
