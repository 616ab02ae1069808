"""The run folders beneath a folder, each with what it is and how far it came."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import RunFolderError, SwitchMTError, reason_of
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.runs.evaluations import played_as, weight_of
from switchmt_snn.runs.folder import RunFolder, read_environment
from switchmt_snn.runs.history import History, read_history

RETURN_WINDOW_EPISODES = 20
"""Newest training returns of a task whose mean stands where there is no evaluation."""
_TRACES = ("environment.json", "config.yaml", "episodes.csv", "metrics.jsonl", "checkpoints")
"""A folder with one of these is, or was, a run."""


@dataclass(frozen=True)
class Score:
    """What is known of a task: the newest evaluation, or else the newest training returns."""

    task: str
    mean: float
    episodes: int
    of: str


@dataclass(frozen=True)
class RunSummary:
    """One run.

    Attributes:
        created: when it began, ISO 8601.
        status: ``running`` (another process has it), ``finished``, or ``stopped`` (it can be continued if it has a
            checkpoint).
        steps: agent steps so far.
        seconds: of all calls, up to their last line in the logs.
        bytes: of all its files.
    """

    path: Path
    created: str
    name: str
    method: str
    tasks: tuple[str, ...]
    seed: int
    status: str
    steps: int
    total_steps: int
    seconds: float
    scores: tuple[Score, ...]
    bytes: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "path": str(self.path), "scores": [vars(score) for score in self.scores]}


@dataclass(frozen=True)
class Damaged:
    """A folder that was a run and cannot be read."""

    path: Path
    problem: str


def list_runs(folder: Path) -> tuple[list[RunSummary], list[Damaged]]:
    """The runs in a folder, or the one that it is, by the time they began; and those that cannot be read.

    Raises:
        RunFolderError: there is no such folder.
    """
    if not folder.is_dir():
        raise RunFolderError(f"no folder {folder}, expected one with run folders; run switchmt-snn train, or name it")
    found = [folder] if RunFolder(folder).is_run else [path for path in sorted(folder.iterdir()) if _is_trace(path)]
    runs, damaged = [], []
    with progress_of("reading logs", len(found), "runs") as progress:
        for path in found:
            try:
                runs.append(summarize(path))
            except (SwitchMTError, OSError) as error:
                damaged.append(Damaged(path, reason_of(error)))
            progress.advance()
    return sorted(runs, key=lambda run: (datetime.fromisoformat(run.created).astimezone(), run.path.name)), damaged


def _is_trace(path: Path) -> bool:
    return path.is_dir() and any((path / name).exists() for name in _TRACES)


def summarize(path: Path) -> RunSummary:
    """What a run is and how far it came.

    Raises:
        SwitchMTError: it is no run, or a file of it cannot be read.
    """
    folder = RunFolder(path).require()
    config, created = folder.config(), when_begun(path)
    return summary_of(folder, config, created, read_history(path, config.tasks.names), folder.evaluations.all())


def summary_of(
    folder: RunFolder,
    config: ExperimentConfig,
    created: str,
    history: History,
    evaluations: Sequence[dict[str, Any]],
) -> RunSummary:
    """``summarize`` of what was read already."""
    path = folder.path
    steps = steps_so_far(folder, history, evaluations)
    return RunSummary(
        path=path,
        created=created,
        name=config.name,
        method=config.network.method,
        tasks=config.tasks.names,
        seed=config.seed,
        status=run_status(folder, config, steps, evaluations),
        steps=steps,
        total_steps=config.total_steps,
        seconds=history.wall_s,
        scores=newest_scores(history, evaluations),
        bytes=folder_bytes(path),
    )


def when_begun(path: Path) -> str:
    """When a run began.

    Raises:
        RunFolderError: its environment.json does not say.
    """
    try:
        created = str(read_environment(path)["created"])
        datetime.fromisoformat(created).astimezone()
    except (KeyError, ValueError, OverflowError) as error:
        raise RunFolderError(
            f"{path / 'environment.json'} does not say when the run began, expected its key created; restore the file"
        ) from error
    return created


def steps_so_far(folder: RunFolder, history: History, evaluations: Sequence[dict[str, Any]]) -> int:
    """The newest step that a log, a checkpoint or an evaluation names."""
    stored = [int(path.name.removeprefix("step-")) for path in folder.checkpoints().paths() if path.name[5:].isdigit()]
    played = [int(one["step"]) for one in evaluations]
    return max([history.last_step, *stored, *played])


def run_status(folder: RunFolder, config: ExperimentConfig, steps: int, evaluations: Sequence[dict[str, Any]]) -> str:
    """``running``, ``finished`` or ``stopped``."""
    if folder.in_use:
        return "running"
    # A run that evaluation.stop_at_returns ended has an evaluation with the seed after that of those during training.
    solved = config.evaluation.stop_at_returns and any(
        one["step"] == steps for one in played_as(evaluations, config.evaluation, config.evaluation.seed + 1)
    )
    return "finished" if solved or steps >= config.total_steps else "stopped"


def newest_scores(history: History, evaluations: Sequence[dict[str, Any]]) -> tuple[Score, ...]:
    """For each task its newest evaluation (of equals that of most weight, ``weight_of``), else its newest returns."""
    scores = []
    for index, task in enumerate(history.task_names):
        played = [
            (one["step"], weight_of(one, row), row["mean"])
            for one in evaluations
            for row in one["tasks"]
            if (row["policy"], row["task"]) == ("agent", task)
        ]
        returns = [one.episode_return for one in history.episodes if one.task == index][-RETURN_WINDOW_EPISODES:]
        if played:
            _, (episodes, _), mean = max(played)
            scores.append(Score(task, mean, episodes, "evaluation"))
        elif returns:
            scores.append(Score(task, sum(returns) / len(returns), len(returns), "training"))
    return tuple(scores)


def folder_bytes(path: Path) -> int:
    """Bytes of all files below a folder; one that vanishes meanwhile has none."""
    total = 0
    for file in path.rglob("*"):
        try:
            total += file.lstat().st_size if not file.is_dir() else 0
        except OSError:
            continue
    return total
