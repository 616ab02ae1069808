"""The engine ``local``: every trial is the command ``train`` in a process of its own, a few at a time."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.config.checks import require
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.study.folder import Attempt, StudyFolder, TrialRun, moment
from switchmt_snn.study.grid import Trial

ATTEMPTS = 2
"""Of a trial in one call: a trial that fails is tried once more."""
POLL_S = 0.2
_PR_SET_PDEATHSIG = 1  # prctl.h of Linux


class Watcher(Protocol):
    """Sees what the engine does; it cannot change it."""

    def started(self, trial: Trial, attempt: int) -> None:
        """A process begins."""

    def ended(self, trial: Trial, attempt: Attempt, again: bool) -> None:
        """A process has ended; ``again``: the trial failed and will be tried once more."""

    def stopping(self, count: int) -> None:
        """So many processes were asked to stop."""

    def tick(self, running: Sequence[Trial], waiting: Sequence[Trial]) -> None:
        """A moment has passed."""


@dataclass
class _Running:
    trial: Trial
    process: subprocess.Popen[bytes]
    began_s: float
    steps: int
    asked: bool = False


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
    threads = max((trial.config.threads or 1 for trial in trials), default=1)
    cores = free_cores()
    most = max(1, cores // threads)
    each = "one thread each" if threads == 1 else f"{threads} threads each"
    require(asked is None or 1 <= asked <= most, "--jobs", asked, f"1 to {most}: {each} on the {cores} cores here")
    return asked or most


def run_trials(
    trials: Sequence[Trial], folder: StudyFolder, jobs: int, watcher: Watcher, stop: Callable[[], bool]
) -> list[Trial]:
    """Train trials to their end, each by ``train`` in its own process; one that fails is tried once more.

    Args:
        trials: those that are not finished, in order.
        folder: prepared.
        jobs: processes at the same time.
        watcher: sees what happens.
        stop: whether the user wants to stop; running trials then save a checkpoint and end.

    Returns:
        the trials that failed.
    """
    waiting, running = deque(trials), list[_Running]()
    tries: Counter[str] = Counter()
    failed: list[Trial] = []
    told = False
    try:
        while running or (waiting and not stop()):
            if stop() and not told and running:
                told = True
                watcher.stopping(len(running))
                _ask_to_stop(running)
            while not stop() and (trial := _next(waiting, len(running), jobs, folder)) is not None:
                tries[trial.name] += 1
                watcher.started(trial, tries[trial.name])
                running.append(_start(trial, folder))
            time.sleep(POLL_S)
            for one in [one for one in running if one.process.poll() is not None]:
                running.remove(one)
                attempt = _attempt(one, folder)
                folder.note_attempt(attempt)
                again = attempt.failed and tries[one.trial.name] < ATTEMPTS
                watcher.ended(one.trial, attempt, again)
                if again:
                    waiting.append(one.trial)
                elif attempt.failed:
                    failed.append(one.trial)
            watcher.tick([one.trial for one in running], list(waiting))
    finally:
        for one in running:  # an error, or a second Ctrl-C: their checkpoints are whole at any moment
            one.process.kill()
            one.process.wait()
    return failed


def _next(waiting: deque[Trial], running: int, jobs: int, folder: StudyFolder) -> Trial | None:
    """The next trial that may begin. One that a process of a killed study still trains is waited for."""
    if running >= jobs:
        return None
    in_use = [trial.name for trial in waiting if RunFolder(folder.run(trial)).in_use]
    if running + len(in_use) >= jobs:
        return None
    for trial in waiting:
        if trial.name not in in_use:
            waiting.remove(trial)
            return trial
    return None


def _start(trial: Trial, folder: StudyFolder) -> _Running:
    steps = TrialRun(folder.run(trial)).steps
    with folder.log(trial).open("ab") as log:
        process = subprocess.Popen(
            command_of(["train", str(folder.config(trial)), "--run", str(folder.run(trial))]),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment_of(trial.config),
            start_new_session=True,  # Ctrl-C reaches the study alone, which asks its trials once
            preexec_fn=_stop_with_parent if sys.platform == "linux" else None,
        )
    return _Running(trial, process, time.monotonic(), steps)


def command_of(words: Sequence[str]) -> list[str]:
    """A command of this program, by this Python."""
    return [sys.executable, "-m", "switchmt_snn", *words]


def environment_of(config: ExperimentConfig) -> dict[str, str]:
    """The environment of a trial's process: no library begins more threads than the trial has."""
    threads = str(config.threads or 1)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**os.environ, **dict.fromkeys(names, threads)}


def _stop_with_parent() -> None:
    """In the new process: ask Linux for a SIGTERM when the study is killed; the trial then saves and ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _ask_to_stop(running: Sequence[_Running]) -> None:
    for one in running:
        one.asked = True
        one.process.send_signal(signal.SIGTERM)


def _attempt(one: _Running, folder: StudyFolder) -> Attempt:
    return Attempt(
        trial=one.trial.name,
        code=one.process.returncode,
        seconds=round(time.monotonic() - one.began_s, 3),
        steps=max(0, TrialRun(folder.run(one.trial)).steps - one.steps),
        asked=one.asked,
        ended=moment(),
    )


def last_words(log: Path) -> str:
    """The last line of a trial's log that says something."""
    try:
        with log.open("rb") as stream:
            stream.seek(max(0, stream.seek(0, 2) - 8_192))
            lines = stream.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
