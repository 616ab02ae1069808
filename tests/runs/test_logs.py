"""Logs hold the numbers themselves: what reads a column back gets what was measured."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from switchmt_snn.config.numbers import exact
from switchmt_snn.errors import RunFolderError
from switchmt_snn.learning.events import EpisodeEnded, LayerHealth, Measured, SwitchDecided
from switchmt_snn.learning.switching import Stay
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.logs import RunLogs

NUMBERS = (1234567.0, 12345678.9, 0.1, -3.0, 1 / 3, 1e-9, 2.0**60, 1e300)


@given(st.floats(allow_nan=False))
def test_a_number_reads_back_as_it_was(value: float) -> None:
    assert float(exact(value)) == value


def test_whole_numbers_have_no_point() -> None:
    assert [exact(value) for value in (21.0, -500.0, 1234567.0, 0.0)] == ["21", "-500", "1234567", "0"]
    assert exact(math.inf) == "inf"


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.parametrize("number", NUMBERS)
def test_tables_of_a_run_hold_numbers_unrounded(number: float, tmp_path: Path) -> None:
    logs = RunLogs(tmp_path, ("a",), ("change",), None)
    logs(EpisodeEnded(9, 0, 1, number, 9, truncated=False, epsilon=abs(number), updates=3))
    logs(SwitchDecided(9, 0, 1, 1, 9, Stay("window", {"change": number})))
    logs.close()
    (episode,), (switch,) = map(_rows, (tmp_path / "episodes.csv", tmp_path / "switches.csv"))
    assert (float(episode["return"]), float(episode["epsilon"])) == (number, abs(number))
    assert float(switch["change"]) == number
    assert RunFolder(tmp_path).initial_and_recent_returns(1) == {"a": ([number], [number])}


MEASURED = Measured(9, 0, 3, 0.5, 1.5, (9,), {"conv": LayerHealth(0.25, 0.5, 0.0)})
EVENTS = (
    EpisodeEnded(9, 0, 1, 2.5, 9, truncated=False, epsilon=0.5, updates=3),
    SwitchDecided(9, 0, 1, 1, 9, Stay("window", {"change": 0.125})),
    MEASURED,
)
LOGS = ("episodes.csv", "switches.csv", "metrics.jsonl")


def test_a_line_is_in_its_file_as_soon_as_it_is_written(tmp_path: Path) -> None:
    """Before any sync, so before the first checkpoint."""
    logs = RunLogs(tmp_path, ("a",), ("change",), None)
    for number in range(1, 4):
        for event, name in zip(EVENTS, LOGS, strict=True):
            logs(event)
            text = (tmp_path / name).read_text()
            assert text.count("\n") == number + (name != "metrics.jsonl")
            assert text.endswith("\n")
    assert json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])["layers"]["conv"]["rate"] == 0.25
    logs.close()


def _written(folder: Path, events: int) -> dict[str, int]:
    logs = RunLogs(folder, ("a",), ("change",), None)
    for _ in range(events):
        for event in EVENTS:
            logs(event)
    sizes = logs.sync()
    logs.close()
    return sizes


def test_longer_logs_are_cut_back_to_the_checkpoint(tmp_path: Path) -> None:
    sizes = _written(tmp_path, 2)
    before = {name: (tmp_path / name).read_bytes() for name in LOGS}
    for name in LOGS:
        with (tmp_path / name).open("ab") as stream:
            stream.write(b"12,half a li")  # a line that a kill cut short
    RunLogs(tmp_path, ("a",), ("change",), sizes).close()
    assert {name: (tmp_path / name).read_bytes() for name in LOGS} == before


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("how", ["shorter", "empty", "missing"])
def test_shorter_logs_are_refused_and_nothing_is_changed(name: str, how: str, tmp_path: Path) -> None:
    sizes = _written(tmp_path, 2)
    path = tmp_path / name
    for other in LOGS:
        with (tmp_path / other).open("ab") as stream:
            stream.write(b"later")
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: sizes[name] - 1 if how == "shorter" else 0])
    before = {other.name: other.read_bytes() for other in tmp_path.iterdir()}
    seen = {"shorter": f"has {sizes[name] - 1:,} bytes", "empty": "has 0 bytes", "missing": "is missing"}[how]
    with pytest.raises(RunFolderError, match=f"{name} {seen}, expected at least the {sizes[name]:,} bytes"):
        RunLogs(tmp_path, ("a",), ("change",), sizes)
    assert {other.name: other.read_bytes() for other in tmp_path.iterdir()} == before
