"""A request to stop that arrives while training is evaluated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn import train
from switchmt_snn.acting.evaluation import EvaluationStopped
from switchmt_snn.runs import run as runs
from tests.runs.test_stop_at_returns import cartpole_and_car, evaluations


@pytest.mark.slow
@pytest.mark.parametrize("goals", [[], [5.0, -200.0]])
def test_an_evaluation_that_was_stopped_is_played_when_the_run_goes_on(
    goals: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run stops at once, and ends as if it had never been stopped."""
    config = cartpole_and_car(goals)
    asked: list[int] = []

    @contextmanager
    def requests() -> Iterator[Callable[[], bool]]:
        yield lambda: bool(asked)

    def asked_meanwhile(*words: Any, stop: Callable[[], bool], **settings: Any) -> None:
        asked.append(1)
        assert stop()
        raise EvaluationStopped

    with monkeypatch.context() as patch:
        patch.setattr(runs, "stop_requests", requests)
        patch.setattr(runs, "evaluate_agent", asked_meanwhile)
        stopped = train(config, tmp_path / "run")
        assert (stopped.status, stopped.step) == ("stopped", 100)
        again = train(config, tmp_path / "run")
        assert (again.status, again.step) == ("stopped", 100)
    assert evaluations(tmp_path / "run") == {}
    result, whole = train(config, tmp_path / "run"), train(config, tmp_path / "whole")
    assert (result.status, result.step) == ("finished", 100 if goals else 300)
    assert result.evaluation == whole.evaluation
    assert evaluations(tmp_path / "run") == evaluations(tmp_path / "whole")
    assert (tmp_path / "run" / "switches.csv").read_text() == (tmp_path / "whole" / "switches.csv").read_text()
