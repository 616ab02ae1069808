"""trackio as an observer: the real library, offline; and what is said where it is missing."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from switchmt_snn.errors import MissingExtraError
from switchmt_snn.learning.events import EpisodeEnded, LayerHealth, Measured, Stepped
from switchmt_snn.viewing.dashboards import Trackio
from tests.conftest import small_config


def test_a_dashboard_that_is_not_installed_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(MissingExtraError, match=r"recording.trackio is true .* pip install 'switchmt-snn\[trackio\]'"):
        Trackio()


@pytest.mark.slow
def test_trackio_gets_every_value_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("trackio")
    from trackio import sqlite_storage, utils

    for module in (utils, sqlite_storage):  # both hold the folder of their import
        monkeypatch.setattr(module, "TRACKIO_DIR", tmp_path / "trackio")

    def refused(*_: Any) -> None:
        raise AssertionError("it asked for the network")

    monkeypatch.setattr(socket.socket, "connect", refused)
    training: Any = SimpleNamespace(config=small_config(), suite=SimpleNamespace(names=("pong", "breakout")))
    folder: Any = SimpleNamespace(path=tmp_path / "mine")
    for resumed_at, step in ((None, 10), (10, 20)):
        dashboard = Trackio()
        dashboard.start(training, folder, resumed_at)
        dashboard(Stepped(step, 0, 0.5, False))
        dashboard(EpisodeEnded(step, 1, 1, 2.5 * step, 7, False, 0.5, 3))
        dashboard(Measured(step + 1, 0, 3, None, 0.25, (step, 0), {"conv1": LayerHealth(0.125, 0.0, 0.0)}))
        dashboard.stop()
    storage = sqlite_storage.SQLiteStorage
    assert storage.get_runs("switchmt-snn") == ["mine"], "a run that is continued goes on in the same one"
    logs = [{key: row[key] for key in row if key != "timestamp"} for row in storage.get_logs("switchmt-snn", "mine")]
    assert logs == [
        {"step": 10, "return/breakout": 25.0, "length_steps/breakout": 7},
        {"step": 11, "learning/q": 0.25, "firing_rate/conv1": 0.125},
        {"step": 20, "return/breakout": 50.0, "length_steps/breakout": 7},
        {"step": 21, "learning/q": 0.25, "firing_rate/conv1": 0.125},
    ]
    assert storage.get_run_config("switchmt-snn", "mine")["seed"] == training.config.seed
    assert capsys.readouterr().out == "", "stdout is for results"
