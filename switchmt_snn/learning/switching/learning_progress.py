"""Tasks are played in proportion to how fast their returns change."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.shares import COLUMNS, DECIDING, Shares, score_ranges
from switchmt_snn.tasks.suite import Reference

PARTS = 4
"""Equal parts of the window, in steps; the slope is fitted to their medians."""


@register_criterion("learning_progress")
class LearningProgress(Criterion):
    """A task's share of the steps is proportional to the absolute slope of its returns; a part is divided equally.

    The slope is that of a least-squares line through the medians of ``PARTS`` parts of the task's own newest
    ``progress_window_steps`` steps: equal steps, so that tasks of short episodes do not look quicker. Absolute, so
    that a task that is being forgotten is played, too. It is divided by reference minus floor score, or, without a
    reference, by the range of all medians that the task ever had. A task with fewer than two parts that hold an episode
    counts as progressing as fast as a task can: from floor to reference in one window. Sources: Matiisen et al. 2017
    (teacher-student curriculum, arXiv 1707.00183), Portelas et al. 2019 (20 % uniform, arXiv 1910.07224).
    """

    columns: ClassVar[tuple[str, ...]] = ("progress", "median_return", *COLUMNS)
    deciding = (DECIDING,)
    judges_learning = False
    SAVED = ("steps", "returns", "lowest", "highest", "progresses", "shares")
    DERIVED = ("window_steps", "config", "ranges")

    def __init__(self, config: SwitchingConfig) -> None:
        self.config = config
        self.window_steps = config.progress_window_steps

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        """Take the ranges of scores, where there are any."""
        self.ranges = score_ranges(self.config, num_tasks, references)
        self.steps: list[list[int]] = [[] for _ in range(num_tasks)]  # the task's own, at each episode's end
        self.returns: list[list[float]] = [[] for _ in range(num_tasks)]
        self.lowest: list[float | None] = [None] * num_tasks  # median of a part
        self.highest: list[float | None] = [None] * num_tasks
        self.progresses = [1.0] * num_tasks  # at each task's newest episode end
        self.shares = Shares(self.config, num_tasks)

    def start_visit(self) -> None:
        """Returns and debts stay."""
        self.shares.start_visit()

    def medians(self, task: int) -> dict[int, float]:
        """Median return of each part of the task's window that holds an episode, by the part's number."""
        if not self.steps[task]:
            return {}
        begins = self.steps[task][-1] - self.window_steps
        part_of = (np.asarray(self.steps[task]) - begins - 1) * PARTS // self.window_steps
        returns = np.asarray(self.returns[task])
        return {int(part): float(np.median(returns[part_of == part])) for part in np.unique(part_of)}

    def progress(self, task: int) -> float:
        """Absolute change over one window, as a share of the task's range of scores; 1 if it is not known yet."""
        medians = self.medians(task)
        if len(medians) < 2:
            return 1.0
        x, y = np.asarray(list(medians), np.float64), np.asarray(list(medians.values()))
        x -= x.mean()
        change = abs(float((x * y).sum() / (x * x).sum())) * PARTS
        known, lowest, highest = self.ranges[task], self.lowest[task], self.highest[task]
        scale = known[1] - known[0] if known is not None else (highest or 0.0) - (lowest or 0.0)
        return min(change / scale, 1.0) if scale > 0 else 0.0

    def wanted(self) -> list[float]:
        """The tasks' shares of the steps now."""
        return self.shares.mixed(np.asarray(self.progresses))

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Take the return in; choose again after ``visit_steps``."""
        task = record.task
        self.shares.pay(task, record.steps_in_visit, self.wanted())
        now = self.shares.steps_by_task[task]
        first = int(np.searchsorted(self.steps[task], now - self.window_steps, side="right"))
        self.steps[task] = [*self.steps[task][first:], now]
        self.returns[task] = [*self.returns[task][first:], record.episode_return]
        medians = self.medians(task)
        seen = [value for value in (self.lowest[task], self.highest[task]) if value is not None]
        self.lowest[task] = min([*seen, *medians.values()])
        self.highest[task] = max([*seen, *medians.values()])
        progress = self.progresses[task] = self.progress(task)
        measured = {"progress": progress, "median_return": medians[max(medians)]}
        return self.shares.verdict(task, self.wanted(), "progress", measured, f"progress {progress:.0%}")

    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        """Of the others, the one that is owed most."""
        self.shares.pay(task, steps_in_visit, self.wanted())
        return self.shares.most_owed(other_than=task)
