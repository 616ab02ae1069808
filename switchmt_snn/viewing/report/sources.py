"""All that a report reads of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import SwitchMTError
from switchmt_snn.learning.events import EpisodeEnded
from switchmt_snn.learning.switching.criterion import Deciding, criterion_class
from switchmt_snn.runs.evaluations import weight_of
from switchmt_snn.runs.folder import RunFolder, read_environment
from switchmt_snn.runs.history import History, policy_columns, read_history
from switchmt_snn.runs.listing import RunSummary, summary_of, when_begun
from switchmt_snn.tasks.registry import find_suite
from switchmt_snn.tasks.suite import Suite


@dataclass(frozen=True)
class Sources:
    """A run as it lies on the disk."""

    folder: RunFolder
    config: ExperimentConfig
    environment: dict[str, Any]
    summary: RunSummary
    history: History
    evaluations: tuple[dict[str, Any], ...]

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names by task index."""
        return self.config.tasks.names

    @cached_property
    def suite(self) -> type[Suite] | None:
        """The suite's published facts; None if its module is not here."""
        try:
            return find_suite(self.config.tasks.suite)
        except SwitchMTError:
            return None

    @cached_property
    def deciding(self) -> tuple[Deciding, ...]:
        """The numbers that decide when to switch; all of them if the policy names none or is not here."""
        try:
            stated = criterion_class(self.config.switching.policy).deciding
        except SwitchMTError:
            stated = ()
        return stated or tuple(Deciding(name) for name in policy_columns(self.history))

    def episodes_of(self, task: int) -> list[EpisodeEnded]:
        """A task's episodes in order."""
        return [one for one in self.history.episodes if one.task == task]

    def newest_evaluation(self, task: str) -> dict[str, Any] | None:
        """The newest evaluation of a task, of equals that of most weight: its rows by policy, and itself."""
        found: tuple[tuple[int, tuple[int, int]], dict[str, Any]] | None = None
        for one in self.evaluations:
            rows = {row["policy"]: row for row in one["tasks"] if row["task"] == task}
            if "agent" in rows:
                rank = (one["step"], weight_of(one, rows["agent"]))
                if found is None or rank >= found[0]:
                    found = rank, {**one, "rows": rows}
        return None if found is None else found[1]


def read_sources(path: Path) -> Sources:
    """Read a run.

    Raises:
        SwitchMTError: it is no run, or a file of it cannot be read.
    """
    folder = RunFolder(path).require()
    config = folder.config()
    history, evaluations = read_history(path, config.tasks.names), tuple(folder.evaluations.all())
    return Sources(
        folder=folder,
        config=config,
        environment=read_environment(path),
        summary=summary_of(folder, config, when_begun(path), history, evaluations),
        history=history,
        evaluations=evaluations,
    )
