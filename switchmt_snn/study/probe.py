"""What a study will cost, from short real runs: each kind of trial trains for some seconds and plays some episodes.

Trials that differ in their seed, switching or number of steps only are one kind. As many probes run at a time as trials
will, because processes that run together are slower than one alone.
"""

from __future__ import annotations

import json
import math
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from switchmt_snn.config import ExperimentConfig, SwitchingConfig, to_dict, to_yaml
from switchmt_snn.errors import TrainingFailed
from switchmt_snn.runs.files import parsed_json
from switchmt_snn.runs.listing import folder_bytes
from switchmt_snn.runs.plan import plan
from switchmt_snn.study.engine import last_words
from switchmt_snn.study.folder import TrialRun
from switchmt_snn.study.grid import Trial
from switchmt_snn.study.processes import ProgramProcess

MEASURED_S = 20.0
"""Seconds of learning that are measured."""
LONGEST_S = 300.0
"""A probe ends after this in any case."""
_METRICS_STEPS = 200
"""Steps between two measurements of a probe, about."""
_FILL_STEPS = 200
"""Steps with which a probe fills a task's replay; a batch must fit."""
_POLL_S = 0.05


@dataclass(frozen=True)
class Cost:
    """What one trial takes.

    Attributes:
        memory_bytes: the largest memory of its process.
        disk_bytes: of its run folder at the end.
    """

    seconds: float
    memory_bytes: int
    disk_bytes: int


@dataclass(frozen=True)
class Pace:
    """What a probe measured.

    Attributes:
        start_s: until the first step.
        end_s: to save a checkpoint and end.
        fill_s: of a step while the replay fills.
        step_s: of a step of learning.
        episode_s: of an evaluation's episode in every task, by the agent and by random play.
        peak_bytes: largest memory of the process.
        checkpoint_bytes: of a checkpoint without replay.
        replay_bytes: of the stored replay, per step.
        log_bytes: of episodes.csv and switches.csv, per step.
        other_bytes: of all other files.
    """

    start_s: float
    end_s: float
    fill_s: float
    step_s: float
    episode_s: float
    peak_bytes: int
    checkpoint_bytes: int
    replay_bytes: float
    log_bytes: float
    other_bytes: int


def kind_of(trial: Trial) -> str:
    """Trials of one kind take the same time per step."""
    config = replace(trial.config, name="probe", seed=0, total_steps=1, switching=SwitchingConfig())
    return json.dumps(to_dict(config), sort_keys=True)


def probe(trials: Sequence[Trial], jobs: int, note: Callable[[str], None]) -> dict[str, Cost]:
    """The cost of trials by name.

    Args:
        trials: those that are to be trained.
        jobs: how many will train at the same time.
        note: receives a line as each kind begins.

    Raises:
        TrainingFailed: a probe fails; the error has its last words.
    """
    kinds: dict[str, Trial] = {}
    for trial in trials:
        kinds.setdefault(kind_of(trial), trial)
    firsts = list(kinds.items())
    padded = [firsts[index % len(firsts)] for index in range(max(len(firsts), min(jobs, len(trials))))]
    stop = threading.Event()
    measured: dict[str, list[Pace]] = {}
    with tempfile.TemporaryDirectory(prefix="switchmt-probe-") as folder, ThreadPoolExecutor(jobs) as pool:
        try:
            works = []
            for number, (kind, trial) in enumerate(padded):
                works.append((kind, pool.submit(_measure, trial, Path(folder) / str(number), stop, note)))
            for kind, work in works:
                measured.setdefault(kind, []).append(work.result())
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return {trial.name: cost_of(trial.config, measured[kind_of(trial)]) for trial in trials}


def _measure(trial: Trial, folder: Path, stop: threading.Event, note: Callable[[str], None]) -> Pace:
    """Train for some seconds, then play some episodes, each by its command."""
    note(f"probing {trial.variant}: {MEASURED_S:.0f} s of learning, then an evaluation")
    folder.mkdir()
    config, run = shortened(trial.config), folder / "run"
    (folder / "config.yaml").write_text(to_yaml(config))
    process = _Process(["train", str(folder / "config.yaml"), "--run", str(run)], config, folder / "log", trial, stop)
    start_s = _until_measured(process, run)
    end_s = process.end()
    rows = _rows(run)
    learned = [row for row in rows if row["updates"] > 0]
    if not rows:
        raise TrainingFailed(f"the probe of {trial.name} measured nothing, expected a trial of more than a few steps")
    steps, first, last = max(1, TrialRun(run).steps), rows[0], rows[-1]
    checkpoints = sorted((run / "checkpoints").glob("step-*"))
    logs = sum((run / name).stat().st_size for name in ("episodes.csv", "switches.csv") if (run / name).is_file())
    whole = folder_bytes(run)
    episodes = min(config.evaluation.episodes, config.evaluation.num_envs)
    words = ["evaluate", str(run), "--episodes", str(episodes), "--json", "--trust"]
    process = _Process(words, config, folder / "log", trial, stop)
    process.wait()
    return Pace(
        start_s=start_s,
        end_s=end_s,
        fill_s=first["wall_s"] / first["step"],
        step_s=_slope(learned) if len(learned) > 1 else last["wall_s"] / last["step"],
        episode_s=max(0.0, process.seconds - start_s) / episodes,
        peak_bytes=max((int(row.get("peak_memory_bytes") or 0) for row in rows), default=0),
        checkpoint_bytes=folder_bytes(checkpoints[-1]) if checkpoints else 0,
        replay_bytes=folder_bytes(run / "checkpoints" / "replay") / steps,
        log_bytes=logs / steps,
        other_bytes=whole - folder_bytes(run / "checkpoints") - logs,
    )


class _Process:
    """A command of the program; killed if the probe is stopped, and ended with it if the probe is killed."""

    def __init__(
        self, words: Sequence[str], config: ExperimentConfig, log: Path, trial: Trial, stop: threading.Event
    ) -> None:
        self._log, self._trial, self._stop = log, trial, stop
        self._began = time.monotonic()
        self._process = ProgramProcess(words, log, config.threads or 1)

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    def runs(self) -> bool:
        """Whether it goes on; waits a moment."""
        if self._stop.is_set():
            self._process.kill()
        time.sleep(_POLL_S)
        return self._process.poll() is None

    def end(self) -> float:
        """Ask it to save and end; the seconds that this took."""
        asked = self.seconds
        if self._process.poll() is None:
            self._process.ask_to_stop()
        self.wait((0, 130, -signal.SIGTERM))
        return self.seconds - asked

    def wait(self, good: Sequence[int] = (0,)) -> None:
        """Wait for its end.

        Raises:
            TrainingFailed: it failed.
        """
        while self.runs():
            continue
        if self._stop.is_set():
            raise TrainingFailed("the probe was interrupted, expected time for it")
        if self._process.poll() not in good:
            raise TrainingFailed(
                f"the probe of {self._trial.name} failed ({last_words(self._log)}), expected a trial that trains"
            )


def shortened(config: ExperimentConfig) -> ExperimentConfig:
    """The same training with a replay that fills soon, an agent that acts by its network, and no long evaluations."""
    learning, fill = config.learning, max(_FILL_STEPS, 2 * config.learning.batch_size)
    every = learning.update_every_steps
    measured = min(max(1, config.total_steps // 4), every * math.ceil(_METRICS_STEPS / every))
    return replace(
        config,
        learning=replace(
            learning, learning_starts_steps=min(learning.learning_starts_steps, fill), epsilon_decay_steps=1
        ),
        evaluation=replace(config.evaluation, every_steps=None, stop_at_returns=()),
        recording=replace(
            config.recording, metrics_every_steps=measured, checkpoint_every_steps=max(config.total_steps, 2)
        ),
    )


def _until_measured(process: _Process, run: Path) -> float:
    """Wait until learning has been measured for long enough, or the run ends; the seconds before its first step."""
    start_s = None
    while process.runs():
        rows = _rows(run)
        if rows and start_s is None:
            start_s = max(0.0, process.seconds - rows[0]["wall_s"])
        learned = [row for row in rows if row["updates"] > 0]
        if learned and learned[-1]["wall_s"] - learned[0]["wall_s"] >= MEASURED_S:
            break
        if rows and process.seconds >= LONGEST_S:
            break
    return process.seconds if start_s is None else start_s


def _rows(run: Path) -> list[dict[str, Any]]:
    """The measurements of a probe so far."""
    try:
        text = (run / "metrics.jsonl").read_text("utf-8")
    except OSError:
        return []
    return [dict(parsed_json(line)) for line in text[: text.rfind("\n") + 1].splitlines()]


def _slope(rows: Sequence[dict[str, Any]]) -> float:
    """Seconds per step between the first and the last of some measurements."""
    first, last = rows[0], rows[-1]
    return float((last["wall_s"] - first["wall_s"]) / (last["step"] - first["step"]))


def cost_of(config: ExperimentConfig, paces: Sequence[Pace]) -> Cost:
    """From what was measured to a whole trial; means over the probes of its kind."""

    def mean(name: str) -> float:
        return sum(float(getattr(pace, name)) for pace in paces) / len(paces)

    total, evaluation = config.total_steps, config.evaluation
    slots = config.learning.replay_capacity_steps * len(config.tasks.names)
    fill = min(total, config.learning.learning_starts_steps * len(config.tasks.names))
    during = 0 if evaluation.every_steps is None else (total - 1) // evaluation.every_steps
    # The first evaluation plays random episodes, too, which later ones read.
    played = evaluation.episodes * mean("episode_s") * (1 + during / 2)
    saved = (1 + total // config.recording.checkpoint_every_steps) * mean("end_s")
    training = fill * mean("fill_s") + (total - fill) * mean("step_s")
    replay = plan(config).memory.replay_bytes * min(1.0, total / slots)
    logged = total * mean("log_bytes") + min(total, slots) * mean("replay_bytes")
    return Cost(
        seconds=mean("start_s") + training + saved + played,
        memory_bytes=int(mean("peak_bytes") + replay),
        disk_bytes=int(config.recording.keep_checkpoints * mean("checkpoint_bytes") + logged + mean("other_bytes")),
    )
