"""A study on the screen: what begins and ends, and now and then how far it is and what is left."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

from rich.console import Console

from switchmt_snn.drawing.numbers import duration
from switchmt_snn.study.engine import last_words
from switchmt_snn.study.folder import Attempt, StudyFolder, TrialRun
from switchmt_snn.study.grid import Study, Trial
from switchmt_snn.study.timing import Clock

EVERY_S = 30.0


class Screen:
    """Plain lines; see ``switchmt_snn.study.engine.Watcher``."""

    def __init__(self, console: Console, study: Study, folder: StudyFolder, jobs: int, finished: int) -> None:
        self.console, self.study, self.folder, self.jobs = console, study, folder, jobs
        self.counts = Counter(finished=finished)
        self._began: dict[str, tuple[float, int]] = {}
        self._clock = Clock(study, folder.attempts())
        self._shown_s = time.monotonic()

    def started(self, trial: Trial, attempt: int) -> None:
        """Note the moment; a second try is said."""
        self._began[trial.name] = time.monotonic(), TrialRun(self.folder.run(trial)).steps
        if attempt > 1:
            self._print(f"trying {trial.name} again")

    def ended(self, trial: Trial, attempt: Attempt, again: bool) -> None:
        """Say how a trial ended, and where to read why."""
        self._clock.add(attempt)
        if attempt.code == 0:
            self.counts["finished"] += 1
            self._print(f"finished {trial.name} ({duration(attempt.seconds)}): {self._scores(trial)}")
        elif attempt.failed:
            self.counts["failed"] += not again
            how = f"exit code {attempt.code}" if attempt.code > 0 else f"signal {-attempt.code}"
            log = self.folder.log(trial)
            self._print(f"failed {trial.name} ({how}): {last_words(log)} [{log}]")
        else:
            self.counts["stopped"] += 1

    def stopping(self, count: int) -> None:
        """Say what is waited for."""
        trials = "1 trial" if count == 1 else f"{count} trials"
        self._print(f"stopping: {trials} save and end (a second Ctrl-C ends them at once)")

    def tick(self, running: Sequence[Trial], waiting: Sequence[Trial]) -> None:
        """Every half minute a line."""
        now = time.monotonic()
        if now - self._shown_s < EVERY_S or not running:
            return
        self._shown_s = now
        at = {trial.name: TrialRun(self.folder.run(trial)).steps for trial in running}
        for trial in running:
            began_s, steps = self._began[trial.name]
            self._clock.watch(trial, now - began_s, at[trial.name] - steps)
        waits = [(trial, TrialRun(self.folder.run(trial)).steps) for trial in waiting]
        left = self._clock.left([(trial, at[trial.name]) for trial in running], waits, self.jobs)
        shares = ", ".join(f"{trial.name} {at[trial.name] / trial.config.total_steps:.0%}" for trial in running)
        failed = f", {self.counts['failed']} failed" if self.counts["failed"] else ""
        self._print(
            f"{self.counts['finished']} of {len(self.study.trials)} trials finished{failed}; left "
            f"{'unknown' if left is None else duration(left)}; running: {shares}"
        )

    def _scores(self, trial: Trial) -> str:
        final = TrialRun(self.folder.run(trial)).final
        rows = [] if final is None else [row for row in final["tasks"] if row["policy"] == "agent"]
        return ", ".join(f"{row['task']} {row['mean']:.4g}" for row in rows)

    def _print(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True)
