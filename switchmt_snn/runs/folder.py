"""The run folder: the only product of training, and all that every other command needs.

config.yaml  environment.json  code_changes.jsonl  metrics.jsonl  episodes.csv  switches.csv  checkpoints/  evaluations/
"""

from __future__ import annotations

import csv
import itertools
import shlex
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import filelock

from switchmt_snn.config import ExperimentConfig, differences, load_config, to_dict, to_yaml
from switchmt_snn.config.bounds import LARGEST
from switchmt_snn.config.trust import allow, modules_in
from switchmt_snn.errors import ConfigError, RunFolderError, WriteError, nearest
from switchmt_snn.runs.checkpoint import CheckpointStore
from switchmt_snn.runs.evaluations import Evaluations
from switchmt_snn.runs.files import json_text, parsed_json, write_atomically, writing

RUNS = Path("runs")
LOCK = {"run.lock"}
_FOLDERS = ("checkpoints", "evaluations")
"""What a new run folder is made of first."""
LOCK_TIMEOUT_S = 0.5
"""A reader that asks whether a run is going on holds its lock for a moment (``RunFolder.in_use``)."""


def claim_new_run(name: str) -> RunFolder:
    """Make a fresh folder under ``runs/``, named by time and config.

    Making a folder is atomic, so of several trainings that begin in one second each gets a folder of its own.

    Raises:
        RunFolderError: it cannot be made.
    """
    base = RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{name}"
    for number in itertools.count(1):
        path = base if number == 1 else base.with_name(f"{base.name}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise WriteError(path, error, "--run") from error
        return RunFolder(path)
    raise AssertionError("unreachable: the numbers do not end")


def latest_run() -> Path:
    """The run under ``runs/`` that was begun last, as its environment.json says; a copied file may be younger.

    Only copies of one run were begun in the same microsecond: of them, the one that is farthest, then the first by name
    (``a`` before ``a-backup``).

    Raises:
        RunFolderError: there is none.
    """
    begun = {path.parent: _begun(path) for path in RUNS.glob("*/environment.json")}
    runs = [(moment, _newest_checkpoint(run), run) for run, moment in sorted(begun.items()) if moment is not None]
    if not runs:
        raise RunFolderError(f"no run in {RUNS.resolve()}, expected one; run switchmt-snn train, or name a run folder")
    return max(runs, key=lambda run: run[:2])[-1]


def _newest_checkpoint(run: Path) -> str:
    """Its name, which sorts by steps; nothing if there is none."""
    return max((path.name for path in CheckpointStore(run / "checkpoints").paths()), default="")


def _begun(path: Path) -> datetime | None:
    """When a run was begun; None if the file is not of a run."""
    try:
        return datetime.fromisoformat(read_environment(path.parent)["created"]).astimezone()
    except (RunFolderError, ValueError, KeyError, TypeError, OverflowError):
        return None


def read_environment(run: Path) -> dict[str, Any]:
    """The content of a run's environment.json.

    Raises:
        RunFolderError: it is missing, or no JSON of a run.
    """
    path = run / "environment.json"
    try:
        facts = parsed_json(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError):
        facts = None
    if not isinstance(facts, dict):
        raise RunFolderError(f"{path} cannot be read, expected the JSON that training wrote; restore the file")
    return facts


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
            return bool(read_environment(self.path).get("program") == "switchmt-snn")
        except RunFolderError:
            return False

    @property
    def _is_free(self) -> bool:
        """Whether nothing is here; an empty folder, a lock, and what a ``create`` that was killed left are nothing."""
        return not self.path.exists() or (self.path.is_dir() and not self._strangers())

    def _strangers(self) -> list[str]:
        """Names of what neither a lock is nor part of a run that was killed while its folder was made.

        ``create`` makes two folders, then config.yaml, and last environment.json; training fills them afterwards.
        """
        names = {entry.name for entry in self.path.iterdir()} - LOCK
        made = [name for name in _FOLDERS if (self.path / name).is_dir() and not any((self.path / name).iterdir())]
        begun = {*made, "config.yaml"} if len(made) == len(_FOLDERS) else {*made}
        unfinished = {name for name in names if name.startswith((".config.yaml.", ".environment.json.")) and made}
        return sorted(names - begun - unfinished)

    def require(self, begin: str | None = None) -> RunFolder:
        """This folder, if it is a run.

        Args:
            begin: the command that begins a run here, for the error; None for the shortest.

        Raises:
            RunFolderError: it does not exist, is empty, or holds something else.
        """
        if self._is_free:
            begin = begin or f"switchmt-snn train quickstart --run {shlex.quote(str(self.path))}"
            beside = [path.parent.name for path in self.path.parent.glob("*/environment.json")]
            raise RunFolderError(
                f"no run folder {self.path}, expected one; a new run needs a config: {begin}"
                f"{nearest(self.path.name, beside)}"
            )
        if not self.is_run:
            raise RunFolderError(
                f"{self.path} is not a run of switchmt-snn (no environment.json of ours), expected a run folder; "
                "name another folder"
            )
        return self

    def require_unchanged(self, was_run: bool) -> None:
        """Refuse a folder that another process made a run of while this one was planned.

        Raises:
            RunFolderError: it became a run in the meantime.
        """
        if self.is_run and not was_run:
            raise RunFolderError(
                f"{self.path} became a run of another process in the meantime, expected a free folder; run the same "
                "command again to continue it, or name another one with --run"
            )

    def threads(self) -> int | None:
        """The threads of PyTorch with which the run began; None if it does not say."""
        threads = read_environment(self.path).get("torch_threads")
        return threads if type(threads) is int and 1 <= threads <= LARGEST["threads"] else None

    def config(self, trust: bool = False) -> ExperimentConfig:
        """The run's resolved config.

        Args:
            trust: let modules that it names be imported, whoever made the run (``switchmt_snn.config.trust``).
        """
        path = self.path / "config.yaml"
        if not path.is_file():
            raise RunFolderError(f"{path} is missing, expected the run's config; the run folder is damaged")
        config = load_config(path, BEFORE, reopen=False, stored=True)
        if trust:
            allow(modules_in(to_dict(config)))
        return config

    def checkpoints(self, keep: int = 2) -> CheckpointStore:
        """The run's checkpoints."""
        return CheckpointStore(self.path / "checkpoints", keep)

    @property
    def evaluations(self) -> Evaluations:
        """The run's evaluations."""
        return Evaluations(self.path / "evaluations")

    @property
    def reestimated_evaluations(self) -> Evaluations:
        """The run's evaluations with re-estimated normalisation statistics: not of the network as it is stored."""
        return Evaluations(self.path / "evaluations" / "reestimated")

    def create(self, config: ExperimentConfig, environment: dict[str, Any], asked: ExperimentConfig) -> None:
        """Make the folder of a new run.

        Args:
            config: decided.
            environment: from ``describe_environment``.
            asked: the config before ``auto`` and null were decided.

        Raises:
            RunFolderError: the folder holds other files, or cannot be written.
        """
        with writing(self.path, "--run"):
            self.path.mkdir(parents=True, exist_ok=True)
            if not self._is_free:
                raise RunFolderError(
                    f"{self.path} holds {self._strangers()[0]!r} but no run, expected an empty or new folder; "
                    "name another one with --run"
                )
            for name in _FOLDERS:
                (self.path / name).mkdir(exist_ok=True)
            write_atomically(self.path / "config.yaml", to_yaml(config, asked).encode())
            # Last: a folder is a run once this file says so.
            write_atomically(self.path / "environment.json", json_text(environment, indent=1).encode())

    def save_config(self, config: ExperimentConfig) -> None:
        """Replace the stored config (a raised step budget)."""
        path = self.path / "config.yaml"
        asked = replace(load_config(path, stored=True), total_steps=config.total_steps)
        write_atomically(path, to_yaml(config, asked).encode())

    def lock(self) -> filelock.BaseFileLock:
        """Take the run for this process.

        Raises:
            RunFolderError: another process has it, or the folder cannot be written.
        """
        return locked(self.path, "run")

    @property
    def in_use(self) -> bool:
        """Whether another process trains here."""
        path = self.path / "run.lock"
        if not path.is_file():
            return False
        lock = filelock.FileLock(path)
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            return True
        except OSError:  # a folder of somebody else's
            return False
        lock.release()
        return False

    def initial_and_recent_returns(self, episodes: int) -> dict[str, tuple[list[float], list[float]]]:
        """First and newest training returns of each task, ``episodes`` each, from episodes.csv."""
        by_task: dict[str, list[float]] = {}
        with (self.path / "episodes.csv").open(encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                by_task.setdefault(row["task"], []).append(float(row["return"]))
        return {task: (values[:episodes], values[-episodes:]) for task, values in by_task.items()}


def locked(folder: Path, what: str, option: str = "--run") -> filelock.BaseFileLock:
    """Take a folder for this process, by the lock ``WHAT.lock`` in it.

    Args:
        folder: made if it is not there.
        what: lives in it: ``run`` or ``study``.
        option: by which a user names another one.

    Raises:
        RunFolderError: another process has it, or the folder cannot be written.
    """
    lock = filelock.FileLock(folder / f"{what}.lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=LOCK_TIMEOUT_S)
    except filelock.Timeout as error:
        raise RunFolderError(
            f"{folder} is in use by another process, expected a free {what} folder; wait for it, or name another "
            f"one with {option}"
        ) from error
    except OSError as error:
        raise WriteError(folder, error, option) from error
    return lock


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
            "name another folder with --run, or continue it with: switchmt-snn train --run "
            f"{shlex.quote(str(path))}"
        )
