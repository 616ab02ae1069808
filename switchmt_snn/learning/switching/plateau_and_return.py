"""A task on a plateau is left, looked at now and then, and played again when its score has fallen."""

from __future__ import annotations

import math

import numpy as np

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.learning.switching.criterion import Criterion, Deciding, EpisodeRecord, Verdict, register_criterion
from switchmt_snn.learning.switching.reward_plateau import RewardPlateau
from switchmt_snn.tasks.suite import Reference


@register_criterion("plateau_and_return")
class PlateauAndReturn(Criterion):
    """Leave a task whose returns no longer rise (``reward_plateau``), and come back when its score falls.

    A task that was left on a plateau rests. Every ``check_every_steps`` it is played for ``check_episodes``; if their
    mean is more than ``fall_t`` standard errors below that of the plateau, the task is learned again, at once.
    Otherwise the task that was interrupted goes on. When all tasks rest, none does: a new round begins. With
    ``learning.update_tasks: all`` a task that rests is still rehearsed. After the task scheduling of ScaleZero (arXiv
    2509.07945), which stops collecting converged tasks; the return is ours.
    """

    columns = (
        *RewardPlateau.columns,
        "check_mean",
        "plateau_mean",
        "fall_errors",
        "fall_t",
        "check_number",
    )
    deciding = (*RewardPlateau.deciding, Deciding("fall_errors", ("fall_t",)))
    SAVED = (
        "plateaus",
        "rests",
        "levels",
        "checked_at_steps",
        "checks",
        "steps",
        "counted_steps",
        "learned",
        "pending",
        "is_over",
    )
    DERIVED = ("config",)

    def __init__(self, config: SwitchingConfig) -> None:
        self.config = config

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        """Begin with every task to be learned."""
        self.plateaus = [RewardPlateau(self.config) for _ in range(num_tasks)]
        self.rests = [False] * num_tasks
        self.levels: list[list[float]] = [[] for _ in range(num_tasks)]  # returns on the plateau
        self.checked_at_steps = [0] * num_tasks
        self.checks: list[float] = []  # returns of the check that goes on
        self.steps = 0  # of the run
        self.learned = 0  # the task that is learned; another one may be played for a check
        self.pending = ""
        self.start_visit()

    def start_visit(self) -> None:
        """Forget the check; what is known of each task stays."""
        self.counted_steps = 0
        self.is_over = False
        self.checks = []

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        """Test the slope of a task that is learned, or the mean of one that is checked."""
        task = record.task
        self._count(record.steps_in_visit)
        if self.is_over:
            return Verdict(False, "visit_over", {})
        self.pending = ""
        if self.rests[task]:
            return self._check(task, record.episode_return)
        self.learned = task
        verdict = self.plateaus[task].end_of_episode(record)
        if verdict.leave:
            self.pending = "plateau"
        elif self._due(task) is not None:
            self.pending = "check"
            return Verdict(True, "check_due", verdict.measured, verdict.summary)
        return verdict

    def _check(self, task: int, episode_return: float) -> Verdict:
        self.checks.append(episode_return)
        measured = {
            "check_mean": float(np.mean(self.checks)),
            "plateau_mean": float(np.mean(self.levels[task])),
            "fall_t": self.config.fall_t,
            "check_number": float(len(self.checks)),
        }
        if len(self.checks) < self.config.check_episodes:
            return Verdict(False, "check", measured, f"check {len(self.checks)} of {self.config.check_episodes}")
        errors = fall_errors(self.levels[task], self.checks)
        measured["fall_errors"] = errors
        summary = f"fallen by {errors:.1f} of {self.config.fall_t:.1f} s.e."
        if errors <= self.config.fall_t:
            return Verdict(True, "still_on_plateau", measured, summary)
        self._wake(task)
        self.learned = task
        return Verdict(False, "score_fell", measured, summary)

    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        """A task whose check is due, else the one that is learned."""
        self._count(steps_in_visit)
        if self.pending == "plateau":
            self.rests[task] = True
            self.levels[task] = list(self.plateaus[task].returns)
        if self.rests[task]:
            self.checked_at_steps[task] = self.steps
        if all(self.rests):
            for each in range(num_tasks):
                self._wake(each)
        if self.learned == task and self.pending != "check":
            in_order = [(task + offset) % num_tasks for offset in range(1, num_tasks + 1)]
            self.learned = next(each for each in in_order if not self.rests[each])
        self.pending, self.is_over = "", True
        due = self._due(task)
        if due is not None:
            return due
        if self.learned != task:
            return self.learned
        # All others rest, and max_stay_steps ends the visit: the one that was not looked at for longest.
        return min((each for each in range(num_tasks) if each != task), key=lambda each: self.checked_at_steps[each])

    def _due(self, task: int) -> int | None:
        """The resting task, other than this one, whose check is due for longest."""
        waits = self.config.check_every_steps
        due = [
            each
            for each, rests in enumerate(self.rests)
            if rests and each != task and self.steps - self.checked_at_steps[each] >= waits
        ]
        return min(due, key=lambda each: self.checked_at_steps[each]) if due else None

    def _wake(self, task: int) -> None:
        self.rests[task] = False
        self.levels[task] = []
        self.plateaus[task].start_visit()

    def _count(self, steps_in_visit: int) -> None:
        self.steps += steps_in_visit - self.counted_steps
        self.counted_steps = steps_in_visit


def fall_errors(before: list[float], after: list[float]) -> float:
    """By how many standard errors the mean fell, with the spread that the returns had before.

    Without any spread, a fall is infinitely many and none is 0.
    """
    fall = float(np.mean(before)) - float(np.mean(after))
    error = float(np.std(before, ddof=1)) * math.sqrt(1 / len(before) + 1 / len(after))
    if error == 0.0:
        return 0.0 if fall == 0.0 else math.copysign(math.inf, fall)
    return fall / error
