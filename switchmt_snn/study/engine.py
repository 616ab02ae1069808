"""The loop of a study: trials begin, end, are tried again, and are asked to stop; an engine says where they train."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.study.folder import Attempt, StudyFolder, TrialRun, moment
from switchmt_snn.study.grid import Trial
from switchmt_snn.study.processes import BEGINS

ATTEMPTS = 2
"""Of a trial in one call: a trial that fails is tried once more."""
POLL_S = 0.2


class Training(Protocol):
    """A trial's ``train`` command that was begun."""

    def poll(self) -> int | None:
        """Its exit code (negative: a signal), or None while it runs."""

    def ask_to_stop(self) -> None:
        """Let it save a checkpoint and end."""

    def kill(self) -> None:
        """End it now; return when it has ended."""


class Engine(Protocol):
    """Where trials train."""

    def jobs(self, trials: Sequence[Trial], asked: int | None) -> int:
        """How many train at the same time: ``asked``, by default as many as fit.

        Raises:
            ConfigError: more were asked for than fit.
        """

    def start(self, trial: Trial, folder: StudyFolder) -> Training:
        """Begin ``train`` for a trial, with its output at the end of the trial's log."""


class Watcher(Protocol):
    """Sees what happens to the trials; it cannot change it."""

    def started(self, trial: Trial, attempt: int) -> None:
        """A trial begins."""

    def ended(self, trial: Trial, attempt: Attempt, again: bool) -> None:
        """A trial has ended; ``again``: it failed and will be tried once more."""

    def stopping(self, count: int) -> None:
        """So many trials were asked to stop."""

    def tick(self, running: Sequence[Trial], waiting: Sequence[Trial]) -> None:
        """A moment has passed."""


@dataclass
class _Running:
    trial: Trial
    training: Training
    began_s: float
    steps: int
    asked: bool = False


def run_trials(
    trials: Sequence[Trial],
    folder: StudyFolder,
    jobs: int,
    engine: Engine,
    watcher: Watcher,
    stop: Callable[[], bool],
) -> list[Trial]:
    """Train trials to their end, each by ``train``; one that fails is tried once more.

    Args:
        trials: those that are not finished, in order.
        folder: prepared.
        jobs: trials at the same time.
        engine: where they train.
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
                for one in running:
                    one.asked = True
                    one.training.ask_to_stop()
            while not stop() and (trial := _next(waiting, len(running), jobs, folder)) is not None:
                tries[trial.name] += 1
                watcher.started(trial, tries[trial.name])
                steps = TrialRun(folder.run(trial)).steps
                running.append(_Running(trial, engine.start(trial, folder), time.monotonic(), steps))
            time.sleep(POLL_S)
            for one, code in [(one, code) for one in running if (code := one.training.poll()) is not None]:
                running.remove(one)
                attempt = _attempt(one, code, folder)
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
            one.training.kill()
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


def _attempt(one: _Running, code: int, folder: StudyFolder) -> Attempt:
    return Attempt(
        trial=one.trial.name,
        code=code,
        seconds=round(time.monotonic() - one.began_s, 3),
        steps=max(0, TrialRun(folder.run(one.trial)).steps - one.steps),
        asked=one.asked,
        ended=moment(),
    )


def training_words(trial: Trial, folder: StudyFolder) -> list[str]:
    """What follows ``switchmt-snn`` in the command of a trial."""
    return ["train", str(folder.config(trial)), "--run", str(folder.run(trial))]


def last_words(log: Path) -> str:
    """The last line that a trial's newest process printed; what to know if it printed none."""
    try:
        with log.open("rb") as stream:
            stream.seek(max(0, stream.seek(0, 2) - 8_192))
            lines = stream.read().decode("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    said = next((line.strip() for line in reversed(lines) if line.strip()), BEGINS)
    return "it printed nothing" if said == BEGINS else said
