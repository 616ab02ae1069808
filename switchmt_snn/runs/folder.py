"""The run folder: the only product of training, and all that every other command needs.

config.yaml  environment.json  code_changes.jsonl  metrics.jsonl  episodes.csv  switches.csv  checkpoints/  evaluations/
"""

from __future__ import annotations

import csv
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import filelock

from switchmt_snn.acting.evaluation import Evaluation
from switchmt_snn.config import ExperimentConfig, differences, load_config, to_yaml
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.runs.checkpoint import CheckpointStore
from switchmt_snn.runs.evaluations import Evaluations
from switchmt_snn.runs.files import json_text, write_atomically

RUNS = Path("runs")


def new_run_path(name: str) -> Path:
    """A fresh folder under ``runs/``, named by time and config."""
    base = RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{name}"
    path, number = base, 2
    while path.exists():
        path, number = Path(f"{base}-{number}"), number + 1
    return path


def latest_run() -> Path:
    """The newest run under ``runs/``.

    Raises:
        RunFolderError: there is none.
    """
    runs = [path.parent for path in RUNS.glob("*/environment.json")]
    if not runs:
        raise RunFolderError(f"no run in {RUNS.resolve()}, expected one; run switchmt-snn train, or name a run folder")
    return max(runs, key=lambda run: ((run / "environment.json").stat().st_mtime, run.name))


BEFORE = {"tasks": {"image_layout": "channels_last"}}
"""What a run did without being asked before a setting existed, where today's default is another. A run stores every
setting, so one that is missing did not exist."""


class RunFolder:
    """Paths and facts of a run; reading needs no lock."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def is_run(self) -> bool:
        """Whether a run of this program lives here."""
        try:
            facts = json.loads((self.path / "environment.json").read_bytes())
        except (OSError, ValueError):
            return False
        return isinstance(facts, dict) and facts.get("program") == "switchmt-snn"

    def require(self) -> RunFolder:
        """This folder, if it is a run.

        Raises:
            RunFolderError: it does not exist, or holds something else.
        """
        if not self.path.exists():
            raise RunFolderError(f"no run folder {self.path}, expected one; run switchmt-snn train --run {self.path}")
        if not self.is_run:
            raise RunFolderError(
                f"{self.path} is not a run of switchmt-snn (no environment.json of ours), expected a run folder; "
                "name another folder"
            )
        return self

    def config(self) -> ExperimentConfig:
        """The run's resolved config."""
        path = self.path / "config.yaml"
        if not path.is_file():
            raise RunFolderError(f"{path} is missing, expected the run's config; the run folder is damaged")
        return load_config(path, BEFORE, reopen=False)

    def checkpoints(self, keep: int = 2) -> CheckpointStore:
        """The run's checkpoints."""
        return CheckpointStore(self.path / "checkpoints", keep)

    @property
    def evaluations(self) -> Evaluations:
        """The run's evaluations."""
        return Evaluations(self.path / "evaluations")

    def create(self, config: ExperimentConfig, environment: dict[str, Any], asked: ExperimentConfig) -> None:
        """Make the folder of a new run.

        Args:
            config: decided.
            environment: from ``describe_environment``.
            asked: the config before ``auto`` and null were decided.

        Raises:
            RunFolderError: the folder holds other files, or cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            strangers = [entry.name for entry in self.path.iterdir() if entry.name not in ("run.lock",)]
            if strangers:
                raise RunFolderError(
                    f"{self.path} holds {sorted(strangers)[0]!r} but no run, expected an empty or new folder; "
                    "name another one with --run"
                )
            (self.path / "checkpoints").mkdir()
            (self.path / "evaluations").mkdir()
            write_atomically(self.path / "config.yaml", to_yaml(config, asked).encode())
            # Last: a folder is a run once this file says so.
            write_atomically(self.path / "environment.json", json_text(environment, indent=1).encode())
        except OSError as error:
            raise RunFolderError(_unwritable(self.path, error)) from error

    def changed_files(self, files_sha256: dict[str, str], step: int) -> list[str]:
        """Names of files that changed since the run last went on; the new hashes are added to ``code_changes.jsonl``.

        Args:
            files_sha256: of today's files, as in environment.json. A file that the run does not know yet is recorded
                without being named.
            step: at which the run goes on.
        """
        path = self.path / "code_changes.jsonl"
        try:
            known = dict(json.loads((self.path / "environment.json").read_bytes()).get("files_sha256", {}))
            rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
            for row in rows:
                known |= row["files_sha256"]
            new = {name: digest for name, digest in files_sha256.items() if known.get(name) != digest}
            if new:
                rows.append({"step": step, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "files_sha256": new})
                write_atomically(path, "".join(json_text(row) + "\n" for row in rows).encode())
        except (ValueError, TypeError, KeyError) as error:
            raise RunFolderError(f"{path} cannot be read ({error!s:.80}), expected JSON lines; delete it") from error
        return [name for name in new if name in known]

    def save_config(self, config: ExperimentConfig) -> None:
        """Replace the stored config (a raised step budget)."""
        path = self.path / "config.yaml"
        asked = replace(load_config(path), total_steps=config.total_steps)
        write_atomically(path, to_yaml(config, asked).encode())

    def lock(self) -> filelock.BaseFileLock:
        """Take the run for this process.

        Raises:
            RunFolderError: another process has it, or the folder cannot be written.
        """
        lock = filelock.FileLock(self.path / "run.lock")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
        except filelock.Timeout as error:
            raise RunFolderError(
                f"{self.path} is in use by another process, expected a free run folder; wait for it, or name another "
                "one with --run"
            ) from error
        except OSError as error:
            raise RunFolderError(_unwritable(self.path, error)) from error
        return lock

    def save_evaluation(self, evaluation: Evaluation) -> Path:
        """Write a summary (JSON) and the episodes (CSV) of an evaluation; returns the CSV's path."""
        try:
            return self.evaluations.save(evaluation)
        except OSError as error:
            raise RunFolderError(_unwritable(self.evaluations.folder, error)) from error

    def initial_and_recent_returns(self, episodes: int) -> dict[str, tuple[list[float], list[float]]]:
        """First and newest training returns of each task, ``episodes`` each, from episodes.csv."""
        by_task: dict[str, list[float]] = {}
        with (self.path / "episodes.csv").open(newline="") as stream:
            for row in csv.DictReader(stream):
                by_task.setdefault(row["task"], []).append(float(row["return"]))
        return {task: (values[:episodes], values[-episodes:]) for task, values in by_task.items()}


def _unwritable(path: Path, error: OSError) -> str:
    return f"{path} cannot be written ({error.strerror or error}), expected a writable folder; name another with --run"


def check_same_config(stored: ExperimentConfig, asked: ExperimentConfig, path: Path) -> None:
    """Allow only a raised step budget between a run's config and the one asked for.

    Raises:
        ConfigError: naming the fields that differ.
    """
    changed = differences(stored, asked)
    raised = changed.pop("total_steps", None)
    if raised is not None and raised[1] < raised[0]:
        changed["total_steps"] = raised
    if changed:
        shown = ", ".join(f"{key} ({old!r} -> {new!r})" for key, (old, new) in sorted(changed.items()))
        raise ConfigError(
            f"{path} holds a run of another config: {shown}; expected the same config (total_steps may be raised); "
            "name another folder with --run, or continue it with: switchmt-snn train --run " + str(path)
        )
