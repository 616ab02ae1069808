"""The engine ``local``: every trial is the command ``train`` in a process on this machine, a few at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence

from switchmt_snn.config.checks import require
from switchmt_snn.study.engine import Training, training_words
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import Trial
from switchmt_snn.study.processes import ProgramProcess


class LocalEngine:
    """Processes on this machine, never more threads than cores."""

    def jobs(self, trials: Sequence[Trial], asked: int | None) -> int:
        """See ``jobs_for``."""
        return jobs_for(trials, asked)

    def start(self, trial: Trial, folder: StudyFolder) -> Training:
        """Begin ``train`` in a process."""
        return ProgramProcess(training_words(trial, folder), folder.log(trial), trial.config.threads or 1)


def free_cores() -> int:
    """The cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # macOS has none
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def jobs_for(trials: Sequence[Trial], asked: int | None) -> int:
    """How many trials train at the same time: never more threads than cores.

    Args:
        trials: each with the threads of its config.
        asked: ``--jobs``; None takes as many as fit.

    Raises:
        ConfigError: more were asked for than fit.
    """
    threads = most_threads(trials)
    cores = free_cores()
    most = max(1, cores // threads)
    each = "one thread each" if threads == 1 else f"{threads} threads each"
    require(asked is None or 1 <= asked <= most, "--jobs", asked, f"1 to {most}: {each} on the {cores} cores here")
    return asked or most


def most_threads(trials: Sequence[Trial]) -> int:
    """The threads of the trial that has most."""
    return max((trial.config.threads or 1 for trial in trials), default=1)
