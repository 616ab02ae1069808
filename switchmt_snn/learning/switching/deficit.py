"""Tasks are played in proportion to how far they are from a reference score."""

from __future__ import annotations

import numpy as np

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching.criterion import Criterion, EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.shares import COLUMNS, DECIDING, Shares, score_ranges
from switchmt_snn.tasks.suite import Reference


@register_criterion("deficit")
class Deficit(Criterion):
    """A task's share of the steps is proportional to ``exp(deficit / temperature)``.

    ``deficit = (reference - score) / (reference - floor)``, within [0, 1]; the score is the mean of the newest returns
    of training, and a task without any has the deficit 1. After Sharma et al. 2017 (arXiv 1702.06053), whose agent
    draws tasks with ``exp((h - s) / (h tau))``: here a floor makes scores below 0 possible, steps are divided and not
    episodes, and nothing is drawn (``Shares``).
    """

    columns = ("score", "deficit", *COLUMNS)
    deciding = (DECIDING,)
    judges_learning = False
    SAVED = ("returns", "shares")
    DERIVED = ("config", "ranges")

    def __init__(self, config: SwitchingConfig) -> None:
        self.config = config

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        """Take the reference scores.

        Raises:
            ConfigError: a task has none.
        """
        self.ranges = [each for each in score_ranges(self.config, num_tasks, references) if each is not None]
        if len(self.ranges) < num_tasks:
            raise ConfigError(
                "switching.policy is deficit, but not every task has a published score, expected "
                f"switching.reference_scores, {num_tasks} numbers"
            )
        self.returns: list[list[float]] = [[] for _ in range(num_tasks)]
        self.shares = Shares(self.config, num_tasks)

    def start_visit(self) -> None:
        """Scores and debts stay."""
        self.shares.start_visit()

    def deficits(self) -> list[float]:
        """By task, within [0, 1]."""
        gaps = []
        for (floor, reference), returns in zip(self.ranges, self.returns, strict=True):
            gap = (reference - float(np.mean(returns))) / (reference - floor) if returns else 1.0
            gaps.append(min(max(gap, 0.0), 1.0))
        return gaps

    def wanted(self) -> list[float]:
        """The tasks' shares of the steps now."""
        gaps = np.asarray(self.deficits())
        return self.shares.mixed(np.exp((gaps - gaps.max()) / self.config.deficit_temperature))

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Take the return in; choose again after ``visit_steps``."""
        task = record.task
        self.shares.pay(task, record.steps_in_visit, self.wanted())
        self.returns[task] = [*self.returns[task], record.episode_return][-self.config.score_episodes :]
        gap = self.deficits()[task]
        measured = {"score": float(np.mean(self.returns[task])), "deficit": gap}
        return self.shares.verdict(task, self.wanted(), "deficit", measured, f"deficit {gap:.0%}")

    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        """Of the others, the one that is owed most."""
        self.shares.pay(task, steps_in_visit, self.wanted())
        return self.shares.most_owed(other_than=task)
