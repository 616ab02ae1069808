"""The numbers of a film: a CSV with a row per frame and task, written as frames are, and a JSON about the whole."""

from __future__ import annotations

import csv
import math
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from switchmt_snn.errors import WriteError
from switchmt_snn.machine.temporary import temporary_beside
from switchmt_snn.runs.files import json_text, made, write_atomically, writing
from switchmt_snn.viewing.film.moments import Moment
from switchmt_snn.viewing.film.panels import Names


class Record:
    """Two files beside a film; they get their names when they are whole."""

    def __init__(self, csv_path: Path, json_path: Path, actions: tuple[str, ...], layers: tuple[str, ...]) -> None:
        self.csv_path, self.json_path = csv_path, json_path
        made(csv_path.parent, "--out")
        self._temporary = temporary_beside(csv_path)
        with writing(csv_path, "--out"):
            self._stream = self._temporary.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream)
        self._layers = layers
        self._write(
            [
                *("frame", "task", "episode", "step", "action", "action_name", "random", "reward", "score", "ended"),
                "value",
                *(f"q_{name}" for name in actions),
                *(f"advantage_{name}" for name in actions),
                *(f"spikes_{name}" for name in layers),
                *(f"rate_{name}" for name in layers),
            ]
        )

    def add(self, frame: int, names: Names, moment: Moment) -> None:
        """Write a task's row of a frame; numbers that do not exist (an action's, a value) are empty."""
        insight = moment.insight
        advantage = insight.advantage_A
        empty = [""] * len(insight.q_A)
        spikes, rates = moment.spikes(), moment.rates()
        self._write(
            [
                *(frame, names.task, moment.episode, moment.step, moment.action, names.actions[moment.action]),
                *(int(moment.random), _plain(moment.reward), _plain(moment.score), int(moment.ended is not None)),
                "" if insight.value is None else _plain(insight.value),
                *map(_plain, insight.q_A.tolist()),
                *(empty if advantage is None else map(_plain, advantage.tolist())),
                *(spikes[name] for name in self._layers),
                *(_plain(rates[name]) for name in self._layers),
            ]
        )

    def _write(self, row: list[Any]) -> None:
        try:
            with writing(self.csv_path):
                self._writer.writerow(row)
        except WriteError:
            self.discard()
            raise

    def close(self, facts: dict[str, Any]) -> None:
        """Finish both files.

        Raises:
            WriteError: the system refused; call ``discard`` then.
        """
        with writing(self.csv_path):
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._temporary.replace(self.csv_path)
        write_atomically(self.json_path, json_text(facts, indent=1).encode())

    def discard(self) -> None:
        """Leave nothing that is not whole."""
        with suppress(OSError):  # rows that were not written yet, on a full disk
            self._stream.close()
        self._temporary.unlink(missing_ok=True)


def _plain(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""
