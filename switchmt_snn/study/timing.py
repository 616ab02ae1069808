"""The time that a study has left, from the time that its trials took."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence

from switchmt_snn.study.folder import Attempt
from switchmt_snn.study.grid import Study, Trial

_TRUSTED_S = 20.0
"""A process that has run for less is no measure: it spent its time on imports."""


class Clock:
    """Seconds per agent step by variant, measured on what has run so far."""

    def __init__(self, study: Study, attempts: Iterable[Attempt]) -> None:
        self._variant = {trial.name: trial.variant for trial in study.trials}
        self._spent: dict[str, list[float]] = {}
        self._running: dict[str, tuple[str, float, int]] = {}
        for attempt in attempts:
            self.add(attempt)

    def add(self, attempt: Attempt) -> None:
        """Count a process that has ended."""
        self._running.pop(attempt.trial, None)
        if attempt.trial in self._variant and not attempt.failed and attempt.steps > 0:
            spent = self._spent.setdefault(self._variant[attempt.trial], [0.0, 0.0])
            spent[0] += attempt.seconds
            spent[1] += attempt.steps

    def watch(self, trial: Trial, seconds: float, steps: int) -> None:
        """Count a process that runs, so far."""
        if seconds >= _TRUSTED_S and steps > 0:
            self._running[trial.name] = trial.variant, seconds, steps

    def seconds_per_step(self, variant: str) -> float | None:
        """Of the variant, else of all; None before anything has run."""
        totals = {name: tuple(spent) for name, spent in self._spent.items()}
        for name, seconds, steps in self._running.values():
            before = totals.get(name, (0.0, 0.0))
            totals[name] = before[0] + seconds, before[1] + steps
        of = [totals[variant]] if variant in totals else list(totals.values())
        steps_made = sum(steps for _, steps in of)
        return sum(seconds for seconds, _ in of) / steps_made if steps_made else None

    def left(
        self, running: Sequence[tuple[Trial, int]], waiting: Sequence[tuple[Trial, int]], jobs: int
    ) -> float | None:
        """Seconds until all trials have ended.

        Args:
            running: trials with the steps that they have made.
            waiting: those that follow, in order.
            jobs: processes at the same time.

        Returns:
            None as long as nothing has been measured.
        """
        seconds = [self._needs(trial, steps) for trial, steps in [*running, *waiting]]
        known = [one for one in seconds if one is not None]
        return None if len(known) < len(seconds) else makespan(known, jobs)

    def _needs(self, trial: Trial, steps: int) -> float | None:
        pace = self.seconds_per_step(trial.variant)
        return None if pace is None else pace * max(0, trial.config.total_steps - steps)


def makespan(seconds: Sequence[float], jobs: int) -> float:
    """The time that works take in order, ``jobs`` at a time.

    Examples:
        >>> makespan([3.0, 1.0, 1.0, 2.0], 2)
        4.0
    """
    ends = [0.0] * max(1, jobs)
    for one in seconds:
        heapq.heapreplace(ends, ends[0] + one)
    return max(ends)
