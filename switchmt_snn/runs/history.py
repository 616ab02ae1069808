"""A run's logs read back: episodes, decisions and measurements, also while the run goes on."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from switchmt_snn.errors import RunFolderError, reason_of
from switchmt_snn.learning.events import EpisodeEnded, LayerHealth, Measured
from switchmt_snn.learning.switching import DECISION_COLUMNS
from switchmt_snn.runs.files import parsed_json

_T = TypeVar("_T")
_MOST = 2**62
_PEAKS = {"process": "peak_memory_bytes", "device": "peak_device_memory_bytes"}


@dataclass(frozen=True)
class Decision:
    """A row of switches.csv; ``numbers`` are the columns that hold a number, the policy's own among them."""

    step: int
    visit: int
    task: str
    switches: bool
    next_task: str
    reason: str
    numbers: dict[str, float]


@dataclass(frozen=True)
class Clocked:
    """A moment of the run: agent steps, and seconds since the call began in which they were made."""

    step: int
    wall_s: float


@dataclass(frozen=True)
class History:
    """The logs of a run.

    Attributes:
        task_names: by task index.
        episodes: in order of their ends.
        decisions: empty if there is no switches.csv.
        measured: rows of metrics.jsonl.
        clock: wall time of episodes and measurements, in order of steps.
        peak_memory_bytes: largest memory of the process and of its device that a row names; None if none does.
    """

    task_names: tuple[str, ...]
    episodes: tuple[EpisodeEnded, ...]
    decisions: tuple[Decision, ...]
    measured: tuple[Measured, ...]
    clock: tuple[Clocked, ...]
    peak_memory_bytes: dict[str, int | None]

    @property
    def last_step(self) -> int:
        """The newest step that a log names; 0 if none does."""
        steps = [rows[-1].step for rows in (self.episodes, self.decisions, self.measured) if rows]
        return max(steps, default=0)

    @property
    def updates(self) -> int:
        """Gradient steps at the newest line that counts them."""
        counts = [rows[-1].updates for rows in (self.episodes, self.measured) if rows]
        return max(counts, default=0)

    @cached_property
    def calls(self) -> tuple[tuple[Clocked, ...], ...]:
        """The clock of each call of ``train``: it starts anew when a run is continued."""
        calls: list[list[Clocked]] = [list(self.clock[:1])]
        for before, now in pairwise(self.clock):
            if now.wall_s < before.wall_s:
                calls.append([])
            calls[-1].append(now)
        return tuple(tuple(call) for call in calls if call)

    @property
    def wall_s(self) -> float:
        """Seconds of all calls, each up to its last line."""
        return sum(call[-1].wall_s for call in self.calls)


def read_history(folder: Path, task_names: tuple[str, ...]) -> History:
    """Read the logs in a run folder; a file that is missing has no rows. A last line without its end is being written.

    Raises:
        RunFolderError: naming the file and the line that cannot be read.
    """

    def episode(row: dict[str, str]) -> tuple[EpisodeEnded, Clocked]:
        ended = EpisodeEnded(
            step=_count(row["step"]),
            task=task_names.index(row["task"]),
            episode=_count(row["episode"]),
            episode_return=_finite(row["return"]),
            length_steps=_count(row["length_steps"]),
            truncated=row["truncated"] == "1",
            epsilon=_finite(row["epsilon"]),
            updates=_count(row["updates"]),
        )
        return ended, Clocked(ended.step, _finite(row["wall_s"]))

    def measurement(line: str) -> tuple[Measured, Clocked, dict[str, int]]:
        row = dict(parsed_json(line))
        measured = Measured(
            step=_count(row["step"]),
            task=task_names.index(row["task"]),
            updates=_count(row["updates"]),
            loss=_number(row["loss"]),
            q=_number(row["q"]),
            steps_by_task=tuple(_count(row["steps_by_task"].get(task, 0)) for task in task_names),
            layers={_layer(name): _health(layer) for name, layer in row["layers"].items()},
        )
        peaks = {key: _count(row[key]) for key in _PEAKS.values() if row.get(key) is not None}
        return measured, Clocked(measured.step, _finite(row["wall_s"])), peaks

    episodes = _table(folder / "episodes.csv", episode)
    decisions = _table(folder / "switches.csv", lambda row: _decision(row, task_names))
    rows = list(_parsed(folder / "metrics.jsonl", enumerate(_whole_lines(folder / "metrics.jsonl"), 1), measurement))
    clock = sorted([one for _, one in episodes] + [one for _, one, _ in rows], key=lambda one: one.step)
    peaks = {name: max((row[key] for _, _, row in rows if key in row), default=None) for name, key in _PEAKS.items()}
    return History(
        task_names=task_names,
        episodes=tuple(one for one, _ in episodes),
        decisions=tuple(decisions),
        measured=tuple(one for one, _, _ in rows),
        clock=tuple(clock),
        peak_memory_bytes=peaks,
    )


def _decision(row: dict[str, str], task_names: tuple[str, ...]) -> Decision:
    texts = ("step", "visit", "task", "decision", "next_task", "reason")
    numbers = {name: float(value) for name, value in row.items() if name not in texts and value}
    if row["decision"] not in ("stay", "switch"):
        raise ValueError(f"decision is {row['decision']!r}")
    for name in (row["task"], *([row["next_task"]] if row["decision"] == "switch" else [])):
        if name not in task_names:
            raise ValueError(f"{name!r} is no task of the run")
    for name in ("episodes_in_visit", "steps_in_visit"):
        _count(numbers[name])
    if not row["reason"].isprintable() or not all(name.isprintable() for name in numbers):
        raise ValueError("a reason or a column is no printable text")
    return Decision(
        step=_count(row["step"]),
        visit=_count(row["visit"]),
        task=row["task"],
        switches=row["decision"] == "switch",
        next_task=row["next_task"],
        reason=row["reason"],
        numbers={name: value for name, value in numbers.items() if math.isfinite(value)},
    )


def policy_columns(history: History) -> tuple[str, ...]:
    """Numbers of the switching policy that the run's decisions hold, beside those that every run has."""
    names = dict.fromkeys(name for decision in history.decisions for name in decision.numbers)
    return tuple(name for name in names if name not in DECISION_COLUMNS)


def _count(value: Any) -> int:
    """A number of steps, episodes or bytes.

    Raises:
        ValueError: it is none.
    """
    count = int(value)
    if not 0 <= count < _MOST:
        raise ValueError(f"{value!s:.40} is not a number from 0")
    return count


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number) or abs(number) > _MOST:
        raise ValueError(f"{value!s:.40} is not a finite number")
    return number


def _number(value: Any) -> float | None:
    return None if value is None else _finite(value)


def _layer(name: str) -> str:
    if not name.isprintable() or len(name) > 200:
        raise ValueError("a layer's name is no printable text")
    return name


def _health(layer: dict[str, Any]) -> LayerHealth:
    return LayerHealth(
        *(math.nan if layer[key] is None else _finite(layer[key]) for key in ("rate", "dead", "saturated"))
    )


def _table(path: Path, parse: Callable[[dict[str, str]], _T]) -> list[_T]:
    lines = _whole_lines(path)

    def numbered() -> Iterator[tuple[int, dict[str, str]]]:
        reader = csv.DictReader(lines)
        for row in reader:
            yield reader.line_num, row

    try:
        return list(_parsed(path, numbered(), parse))
    except csv.Error as error:
        raise RunFolderError(
            f"{path} is no table ({error}), expected a log of a run; restore it from a copy"
        ) from error


def _parsed(path: Path, rows: Iterator[tuple[int, Any]], parse: Callable[[Any], _T]) -> Iterator[_T]:
    for number, row in rows:
        try:
            yield parse(row)
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise RunFolderError(
                f"{path} line {number} cannot be read ({reason_of(error):.80}), expected a line as training "
                "writes it; restore the file from a copy, or delete the line"
            ) from error


def _whole_lines(path: Path) -> Sequence[str]:
    """The lines that have their end."""
    if not path.exists():
        return []
    try:
        if not path.is_file():
            raise OSError("it is no plain file")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = "it is no text" if isinstance(error, UnicodeDecodeError) else error.strerror or error
        raise RunFolderError(f"{path} cannot be read ({reason}), expected a log; restore it from a copy") from error
    return text[: text.rfind("\n") + 1].splitlines()
