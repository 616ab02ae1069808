"""Tasks are played in proportion to what a step is expected to add to the harmonic mean of their scores."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching.criterion import EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.learning_progress import LearningProgress
from switchmt_snn.tasks.suite import Reference

LEAST_SCORE = 0.05
"""A task that scores less counts as this much of its reference; else the first task without a score would take all."""


@register_criterion("harmonic_gain")
class HarmonicGain(LearningProgress):
    """A task's share of the steps is proportional to ``progress / score^2``; a part is divided equally.

    With scores ``s_i = min((return - floor) / (reference - floor), 1)``, the harmonic mean ``K / sum(1 / s_i)`` rises
    with ``s_i`` in proportion to ``1 / s_i^2``, and ``s_i`` with a step by the task's slope (``learning_progress``).
    So a task far behind is played where it can be learned, and neither one that does not move nor one that has reached
    its reference takes steps from the others. The score is the mean of the newest ``score_episodes`` returns. Ours;
    ``deficit`` looks at the scores alone, ``learning_progress`` at the slopes alone.
    """

    columns: ClassVar[tuple[str, ...]] = ("score", *LearningProgress.columns)

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        """Take the reference scores.

        Raises:
            ConfigError: a task has none.
        """
        super().meet_tasks(num_tasks, references)
        if any(each is None for each in self.ranges):
            raise ConfigError(
                "switching.policy is harmonic_gain, but not every task has a published score, expected "
                f"switching.reference_scores, {num_tasks} numbers"
            )

    def score(self, task: int) -> float:
        """Of the task's newest returns, as a share of its reference within [``LEAST_SCORE``, 1]."""
        limits, returns = self.ranges[task], self.returns[task][-self.config.score_episodes :]
        if limits is None or not returns:
            return LEAST_SCORE
        floor, reference = limits
        return min(max((float(np.mean(returns)) - floor) / (reference - floor), LEAST_SCORE), 1.0)

    def wanted(self) -> list[float]:
        """The tasks' shares of the steps now."""
        scores = np.asarray([self.score(task) for task in range(len(self.ranges))])
        slopes = np.where(scores < 1.0, scores**-2.0, 0.0)
        return self.shares.mixed(slopes * np.asarray(self.progresses))

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Take the return in; choose again after ``visit_steps``."""
        verdict = super().end_of_episode(record)
        reason = "harmonic_gain" if verdict.leave else verdict.reason
        return replace(verdict, reason=reason, measured=verdict.measured | {"score": self.score(record.task)})
