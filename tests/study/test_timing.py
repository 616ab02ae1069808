"""The time that a study has left."""

from __future__ import annotations

from pathlib import Path

import pytest

from switchmt_snn.study.folder import Attempt
from switchmt_snn.study.grid import load_study
from switchmt_snn.study.timing import Clock, makespan


def attempt(trial: str, seconds: float, steps: int, code: int = 0) -> Attempt:
    return Attempt(trial, code, seconds, steps, False, "")


@pytest.fixture
def study(tmp_path: Path):  # type: ignore[no-untyped-def]
    (tmp_path / "s.yaml").write_text(
        "base: cartpole\nseeds: 2\nvariants: {a: {total_steps: 1000}, b: {total_steps: 2000}}\n"
    )
    return load_study(tmp_path / "s.yaml")


def test_a_variant_has_its_own_speed_and_an_unknown_one_that_of_all(study) -> None:  # type: ignore[no-untyped-def]
    clock = Clock(study, [])
    waiting = [(trial, 0) for trial in study.trials]
    assert clock.left([], waiting, 1) is None
    clock.add(attempt("a_seed1", 100.0, 1000))
    assert clock.seconds_per_step("a") == clock.seconds_per_step("b") == 0.1
    clock.add(attempt("b_seed1", 50.0, 2000))
    clock.add(attempt("b_seed2", 900.0, 0, code=1))  # a failure is no measure
    assert clock.seconds_per_step("a") == 0.1
    assert clock.seconds_per_step("b") == 0.025
    a, b = study.trials[2], study.trials[3]
    assert clock.left([(a, 400)], [(b, 1000)], 1) == pytest.approx(60 + 25)
    assert clock.left([(a, 400)], [(b, 1000)], 2) == pytest.approx(60)


def test_a_process_that_runs_counts_until_it_ends(study) -> None:  # type: ignore[no-untyped-def]
    clock, trial = Clock(study, []), study.trials[0]
    clock.watch(trial, 5.0, 10)
    assert clock.seconds_per_step("a") is None  # imports, mostly
    clock.watch(trial, 40.0, 400)
    assert clock.seconds_per_step("a") == 0.1
    clock.add(attempt(trial.name, 200.0, 1000))
    assert clock.seconds_per_step("a") == 0.2


def test_works_are_taken_in_order_by_whoever_is_free() -> None:
    assert makespan([3.0, 1.0, 1.0, 2.0], 2) == 4.0
    assert makespan([], 3) == 0.0
