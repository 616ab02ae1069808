"""The logs of a running training: episodes.csv, switches.csv and metrics.jsonl. Everything else only shows them."""

from __future__ import annotations

import csv
import os
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from switchmt_snn.config.numbers import exact
from switchmt_snn.errors import RunFolderError
from switchmt_snn.learning.events import EpisodeEnded, Event, Measured, SwitchDecided
from switchmt_snn.learning.switching import DECISION_COLUMNS, SwitchTo
from switchmt_snn.machine.memory import peak_bytes, peak_device_bytes
from switchmt_snn.runs.files import json_text, writing

EPISODE_COLUMNS = ("step", "task", "episode", "return", "length_steps", "truncated", "epsilon", "updates", "wall_s")


class RunLogs:
    """An observer that writes events down, each as one whole line at once: who reads a log sees all that happened.

    Numbers are written so that they read back as the same ones. Rows follow the header of their file, also that of an
    older version.
    """

    def __init__(
        self, folder: Path, task_names: tuple[str, ...], measured: tuple[str, ...], sizes: dict[str, int] | None
    ) -> None:
        """Open the logs.

        Args:
            folder: the run folder.
            task_names: by task index.
            measured: names of the numbers that the switching criterion reports; columns of switches.csv.
            sizes: bytes of each file at the checkpoint that is continued, to which it is cut back;
                None begins the logs.

        Raises:
            RunFolderError: a file that is continued is missing, is shorter than at the checkpoint, or has no column for
                one of the numbers. No file is changed then.
        """
        self._folder, self._tasks = folder, task_names
        self._started = time.monotonic()
        if sizes is not None:
            _require_bytes(folder, sizes)
        tables = {"episodes.csv": EPISODE_COLUMNS, "switches.csv": (*DECISION_COLUMNS, *measured)}
        if sizes is not None:
            tables = {name: _header(folder / name, columns) for name, columns in tables.items()}
        self._files = {name: _opened(folder / name, sizes) for name in (*tables, "metrics.jsonl")}
        self._tables = {
            name: csv.DictWriter(self._files[name], columns, restval="", lineterminator="\n")
            for name, columns in tables.items()
        }
        if sizes is None:
            for name, table in self._tables.items():
                with writing(folder / name):
                    table.writeheader()

    def __call__(self, event: Event) -> None:
        """Write an event down.

        Raises:
            WriteError: the system refused.
        """
        wall_s = round(time.monotonic() - self._started, 3)
        if isinstance(event, EpisodeEnded):
            self._write_row("episodes.csv", self._episode_row(event) | {"wall_s": wall_s})
        elif isinstance(event, SwitchDecided):
            self._write_row("switches.csv", self._switch_row(event))
        elif isinstance(event, Measured):
            taken = {"peak_memory_bytes": peak_bytes(), "peak_device_memory_bytes": peak_device_bytes()}
            row = self._metrics_row(event) | {"wall_s": wall_s} | taken
            with writing(self._folder / "metrics.jsonl"):
                self._files["metrics.jsonl"].write(json_text(row) + "\n")

    def _write_row(self, name: str, row: dict[str, Any]) -> None:
        with writing(self._folder / name):
            self._tables[name].writerow(row)

    def _episode_row(self, event: EpisodeEnded) -> dict[str, Any]:
        return {
            "step": event.step,
            "task": self._tasks[event.task],
            "episode": event.episode,
            "return": exact(event.episode_return),
            "length_steps": event.length_steps,
            "truncated": int(event.truncated),
            "epsilon": exact(event.epsilon),
            "updates": event.updates,
        }

    def _switch_row(self, event: SwitchDecided) -> dict[str, Any]:
        decision = event.decision
        switches = isinstance(decision, SwitchTo)
        return {
            "step": event.step,
            "visit": event.visit,
            "task": self._tasks[event.task],
            "episodes_in_visit": event.episodes_in_visit,
            "steps_in_visit": event.steps_in_visit,
            "decision": "switch" if switches else "stay",
            "next_task": self._tasks[decision.task] if isinstance(decision, SwitchTo) else "",
            "reason": decision.reason,
            **{name: exact(value) for name, value in decision.measured.items()},
        }

    def _metrics_row(self, event: Measured) -> dict[str, Any]:
        return {
            "step": event.step,
            "task": self._tasks[event.task],
            "updates": event.updates,
            "loss": event.loss,
            "q": event.q,
            "steps_by_task": dict(zip(self._tasks, event.steps_by_task, strict=True)),
            "layers": {name: asdict(health) for name, health in event.layers.items()},
        }

    def sync(self) -> dict[str, int]:
        """Bring everything to the disk; returns the size of each file."""
        sizes = {}
        for name, stream in self._files.items():
            with writing(self._folder / name):
                stream.flush()
                os.fsync(stream.fileno())
                sizes[name] = stream.tell()
        return sizes

    def close(self) -> None:
        """Close the files. A line that could not be written raised its error when it was written."""
        for stream in self._files.values():
            with suppress(OSError):
                stream.close()


def _require_bytes(folder: Path, sizes: dict[str, int]) -> None:
    """Refuse logs that lack what they had at the checkpoint; cutting such a file "back" would fill it with zeros.

    Raises:
        RunFolderError: naming the file.
    """
    for name, expected in sizes.items():
        path = folder / name
        seen = path.stat().st_size if path.is_file() else None
        if seen is None or seen < expected:
            raise RunFolderError(
                f"{path} {'is missing' if seen is None else f'has {seen:,} bytes'}, expected at least the {expected:,} "
                "bytes that it had at the checkpoint; put the file back, or begin another run with --run"
            )


def _opened(path: Path, sizes: dict[str, int] | None) -> IO[str]:
    with writing(path):
        stream = path.open("a", buffering=1, encoding="utf-8", newline="")  # 1: line by line
        stream.truncate(0 if sizes is None else sizes[path.name])
    return stream


def _header(path: Path, needed: tuple[str, ...]) -> tuple[str, ...]:
    """The columns of a table that is continued; it has more than the needed ones if an older version began it.

    Raises:
        RunFolderError: it lacks one.
    """
    with path.open(encoding="utf-8", newline="") as stream:
        header = tuple(next(csv.reader(stream), ()))
    for column in needed:
        if column not in header:
            raise RunFolderError(
                f"{path} has no column {column!r}, expected one for every number that switching.policy measures; "
                "continue the run with the policy as it was when the run began, or begin another run"
            )
    return header
