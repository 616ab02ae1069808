"""The decision rule of docs/studies.md, on scores that were made up to meet all or all but one of its conditions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.study.grid import Study, Trial
from switchmt_snn.study.results import TaskResult, TrialResult
from switchmt_snn.study.tables import Results, study_tables, why_no_shares

SEEDS = range(1, 7)  # with six, the smallest p is 2 / 2^6 = 0.031
TASKS = ("easy", "own.module:Hard-v0")


def study_of(scores: dict[str, list[tuple[float, float]]], references: dict[str, Any]) -> tuple[Study, list[Any]]:
    """A study whose variants have these scores of both tasks, one pair for each seed."""
    trials, results = [], []
    for variant, pairs in scores.items():
        for seed, means in zip(SEEDS, pairs, strict=True):
            trial = Trial(f"{variant}_seed{seed}", variant, seed, ExperimentConfig())
            rows = tuple(
                TaskResult(trial.name, variant, seed, task, mean, 0.1, 0.0, 30, 50, 5, 1, ((100, mean),), None)
                for task, mean in zip(TASKS, means, strict=True)
            )
            trials.append(trial)
            results.append(TrialResult(trial, 100, 10, 1, "made up", rows, None))  # type: ignore[arg-type]
    return Study("made_up", tuple(trials), references, "uniform"), results


BASE = [(0.5 + seed / 100, 0.5) for seed in SEEDS]
HIGHER = [(one + 0.2, other + 0.2) for one, other in BASE]
ONE_SEED_LOWER = [*HIGHER[:5], (0.55, 0.5)]
ONE_TASK_LOWER = [(0.45, 0.95) for _ in SEEDS]
REFERENCES = {TASKS[0]: 1.0, TASKS[1]: 1.0}


def decision(study: Study, results: list[Any]) -> dict[str, list[Any]]:
    (table,) = (one for one in study_tables(study, results) if one.name == "decision")
    return {name: list(cells) for name, *cells in table.rows}


@pytest.mark.parametrize(
    ("other", "answers"),
    [
        (HIGHER, ["yes", "yes", "none", "yes"]),
        (BASE, ["no", "no", "none", "no"]),
        (ONE_SEED_LOWER, ["yes", "no", "none", "no"]),
        (ONE_TASK_LOWER, ["yes", "yes", "easy", "no"]),
        ([(one, other - 0.3) for one, other in BASE], ["no", "yes", "Hard-v0", "no"]),
    ],
)
def test_a_variant_is_preferred_if_all_conditions_hold(other: list[tuple[float, float]], answers: list[str]) -> None:
    study, results = study_of({"uniform": BASE, "other": other}, REFERENCES)
    assert decision(study, results) == {"other": answers}


@pytest.mark.parametrize(
    ("references", "random", "why"),
    [
        (REFERENCES, 0.0, None),
        ({TASKS[0]: 1.0}, 0.0, None),
        ({TASKS[0]: 1.0, TASKS[1]: 0.0}, -0.5, None),
        (
            {TASKS[0]: 1.0, TASKS[1]: -1.0},
            -0.5,
            "the reference of Hard-v0 is -1, random play, which counts as 0, scores -0.5",
        ),
        (
            {TASKS[0]: -0.5, TASKS[1]: 1.0},
            -0.5,
            "the reference of easy is -0.5, random play, which counts as 0, scores -0.5",
        ),
        ({TASKS[0]: 1.0, TASKS[1]: -1.0}, None, "random play of easy was not evaluated, which counts as 0"),
        (
            {TASKS[0]: 1.0, TASKS[1]: "later"},
            0.0,
            "no trial of later has finished, whose score is the reference of Hard-v0",
        ),
    ],
)
def test_tables_say_why_they_have_no_shares(references: dict[str, Any], random: float | None, why: str | None) -> None:
    study, results = study_of({"uniform": BASE, "other": HIGHER}, references)
    results = [replace(one, tasks=tuple(replace(row, random_mean=random) for row in one.tasks)) for one in results]
    assert why_no_shares(Results(study, results)) == why
    tables = {one.name for one in study_tables(study, results)}
    assert ({"shares", "decision"} <= tables) == (why is None and len(references) == 2)


def test_p_is_corrected_for_the_number_of_variants() -> None:
    """0.031 passes alone and not beside a second variant."""
    study, results = study_of({"uniform": BASE, "one": HIGHER, "two": HIGHER}, REFERENCES)
    assert decision(study, results) == {name: ["yes", "no", "none", "no"] for name in ("one", "two")}


def test_an_unfinished_study_decides_nothing() -> None:
    study, results = study_of({"uniform": BASE, "other": HIGHER}, REFERENCES)
    assert decision(study, results[:-1])["other"][-1] == "not finished"
    assert [one.name for one in study_tables(replace(study, references={}), results)].count("decision") == 0


def test_tasks_are_named_without_their_module_where_that_tells_them_apart() -> None:
    study, results = study_of({"uniform": BASE}, REFERENCES)
    assert [Results(study, results).shown(task) for task in TASKS] == ["easy", "Hard-v0"]
    both = [replace(one, tasks=(*one.tasks, replace(one.tasks[0], task="other:Hard-v0"))) for one in results]
    assert Results(study, both).shown("other:Hard-v0") == "other:Hard-v0"
