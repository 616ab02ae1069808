"""Logs hold the numbers themselves: what reads a column back gets what was measured."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from switchmt_snn.config.numbers import exact
from switchmt_snn.learning.events import EpisodeEnded, SwitchDecided
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
