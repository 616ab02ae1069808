"""The tables of a study: scores, shares of the references, what was played, and what training went through.

Intervals are 95 % bootstrap intervals over seeds (``statistics.py``), with fixed random numbers: the same trials give
the same tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from switchmt_snn.drawing.numbers import digits
from switchmt_snn.study import statistics
from switchmt_snn.study.grid import Study
from switchmt_snn.study.results import TaskResult, TrialResult
from switchmt_snn.viewing.names import shown_task

SIGNIFICANT = 0.05
"""Of the decision rule: p after Holm's correction is below it (docs/studies.md)."""


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds with its interval; no interval with one seed."""

    value: float
    low: float | None
    high: float | None
    seeds: int

    def __str__(self) -> str:
        interval = "" if self.low is None or self.high is None else f" [{digits(self.low)}, {digits(self.high)}]"
        return f"{digits(self.value)}{interval}"


@dataclass(frozen=True)
class Table:
    """A table: cells are texts, estimates, whole numbers, or None.

    Attributes:
        name: a short name, for JSON.
        note: what the numbers are.
        rows: one per variant, its name first.
    """

    name: str
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def texts(self) -> list[list[str]]:
        """The cells as they are shown."""
        return [[shown_cell(cell) for cell in row] for row in self.rows]

    def to_dict(self) -> dict[str, Any]:
        """Plain values: estimates as objects with value, low, high and seeds."""
        rows = [
            {
                column: vars(cell) if isinstance(cell, Estimate) else cell
                for column, cell in zip(self.columns, row, strict=True)
            }
            for row in self.rows
        ]
        return {"name": self.name, "title": self.title, "note": self.note, "rows": rows}


def shown_cell(cell: Any) -> str:
    """A cell as text."""
    if cell is None:
        return ""
    if isinstance(cell, int):
        return f"{cell:,}"
    return digits(cell) if isinstance(cell, float) else str(cell)


class Results:
    """Finished trials by variant and task, in the study's order."""

    def __init__(self, study: Study, results: Sequence[TrialResult]) -> None:
        self.study = study
        self.results = results
        self.variants = tuple(name for name in study.variants if self.of(name))
        self.tasks = tuple(dict.fromkeys(row.task for one in results for row in one.tasks))

    def shown(self, task: str) -> str:
        """A task's name in a table."""
        return shown_task(task, self.tasks)

    @property
    def finished(self) -> bool:
        """Whether every trial has finished."""
        return len(self.results) == len(self.study.trials)

    def of(self, variant: str) -> list[TrialResult]:
        """A variant's finished trials by seed."""
        return sorted((one for one in self.results if one.trial.variant == variant), key=lambda one: one.trial.seed)

    def rows(self, variant: str, task: str) -> list[TaskResult]:
        """A task's rows by seed."""
        return [row for one in self.of(variant) for row in one.tasks if row.task == task]

    def scores(self, variant: str, tasks: Sequence[str]) -> Any:
        """``[S, K]`` by seed and task; None if the variant does not play all of them."""
        rows = [[row.mean for row in self.rows(variant, task)] for task in tasks]
        return np.asarray(rows).T if rows and all(rows) else None


def study_tables(study: Study, results: Sequence[TrialResult]) -> list[Table]:
    """All tables that the finished trials allow."""
    found = Results(study, results)
    if not results:
        return []
    made = [_scores(found), _shares(found), _decision(found), _played(found), _over_training(found)]
    return [table for table in made if table is not None]


def _estimate(values: Sequence[float] | Any) -> Estimate:
    """Mean over seeds."""
    numbers = np.asarray(values, np.float64)
    if len(numbers) < 2:
        return Estimate(float(numbers.mean()), None, None, len(numbers))
    interval = statistics.bootstrap_interval(statistics.mean_score, numbers[:, None])
    return Estimate(interval.value, interval.low, interval.high, len(numbers))


def _by_task(
    found: Results, variant: str, number: Callable[[TaskResult], float | None], whole: bool = False
) -> list[Any]:
    """A cell per task: the mean over seeds; None for a task that the variant does not play."""
    cells: list[Any] = []
    for task in found.tasks:
        values = [value for value in map(number, found.rows(variant, task)) if value is not None]
        if not values:
            cells.append(None)
        else:
            cells.append(round(float(np.mean(values))) if whole else _estimate(values))
    return cells


def _scores(found: Results) -> Table:
    rows = [(name, len(found.of(name)), *_by_task(found, name, lambda row: row.mean)) for name in found.variants]
    random = [_random_play(found, task) for task in found.tasks]
    protocols = list(dict.fromkeys(one.protocol for one in found.results))
    return Table(
        name="scores",
        title="Scores",
        note="Raw return of the final network; mean over seeds and its 95 % interval. Protocol: "
        + "; or ".join(protocols),
        columns=("variant", "seeds", *map(found.shown, found.tasks)),
        rows=(*rows, ("random play", None, *random)),
    )


def references_of(found: Results) -> dict[str, float]:
    """The score of each task that counts as 1, as far as it is known by now."""
    known = {}
    for task, value in found.study.references.items():
        if isinstance(value, float):
            known[task] = value
        elif rows := found.rows(value, task):
            known[task] = float(np.mean([row.mean for row in rows]))
    return known


@dataclass(frozen=True)
class Shares:
    """Shares of the references ``[S, K]`` by variant, of those that play every task with a reference.

    Attributes:
        floors: by task, what counts as 0; None for 0.
    """

    tasks: tuple[str, ...]
    references: dict[str, float]
    floors: tuple[float, ...] | None
    by_variant: dict[str, Any]


def why_no_shares(found: Results) -> str | None:
    """Why results have no shares of their references; None if they have, or fewer than two references were named."""
    if len(found.study.references) < 2:
        return None
    references = references_of(found)
    for task, variant in found.study.references.items():
        if task not in references:
            return f"no trial of {variant} has finished, whose score is the reference of {found.shown(task)}"
    if min(references.values()) > 0:
        return None
    for task, reference in references.items():
        floor = _random_play(found, task)
        if floor is None:
            return f"random play of {found.shown(task)} was not evaluated, which counts as 0"
        if reference <= floor:
            return (
                f"the reference of {found.shown(task)} is {digits(reference)}, random play, which counts as 0, scores "
                f"{digits(floor)}"
            )
    return None


def _random_play(found: Results, task: str) -> float | None:
    """What random play scored in a task, mean over all trials; None if it was not evaluated."""
    means = [row.random_mean for name in found.variants for row in found.rows(name, task)]
    known = [mean for mean in means if mean is not None]
    return float(np.mean(known)) if known else None


def shares_of(found: Results) -> Shares | None:
    """Shares of the references; None without two or more (``why_no_shares``)."""
    references = references_of(found)
    tasks = [task for task in found.tasks if task in references]
    if len(tasks) < 2 or why_no_shares(found) is not None:
        return None
    floors = [_random_play(found, task) or 0.0 for task in tasks] if min(references.values()) <= 0 else None
    shares = {}
    for name in found.variants:
        scores = found.scores(name, tasks)
        if scores is not None:
            shares[name] = statistics.share_of_reference(scores, [references[task] for task in tasks], floors)
    return Shares(tuple(tasks), references, None if floors is None else tuple(floors), shares)


def _shares(found: Results) -> Table | None:
    """Shares of the references, and the comparison with the baseline."""
    known = shares_of(found)
    if known is None:
        return None
    tasks, references, floors, shares = known.tasks, known.references, known.floors, known.by_variant
    rows = []
    compared = _compared(found, {name: statistics.harmonic_mean_over_tasks(one) for name, one in shares.items()})
    for name, share in shares.items():
        middle = float(statistics.interquartile_mean(share))
        interval = Estimate(middle, None, None, len(share))
        if len(share) > 1:
            whole = statistics.bootstrap_interval(statistics.interquartile_mean, share)
            interval = Estimate(whole.value, whole.low, whole.high, len(share))
        rows.append(
            (
                name,
                *(_estimate(share[:, index]) for index in range(len(tasks))),
                interval,
                _estimate(statistics.minimum_over_tasks(share)),
                _estimate(statistics.harmonic_mean_over_tasks(share)),
                *compared.get(name, (None, None)),
            )
        )
    what = "score / reference" if floors is None else "(score - random play) / (reference - random play)"
    named = ", ".join(f"{found.shown(task)} {digits(references[task])}" for task in tasks)
    baseline = found.study.baseline
    return Table(
        name="shares",
        title="Shares of the references",
        note=f"min({what}, 1) with the references {named}. IQM: mean of the middle half of all seeds and tasks. "
        f"P(> {baseline}): probability that a seed's harmonic mean is above one of the baseline's. p: of no difference "
        "in the harmonic mean over paired seeds (sign flips), after Holm over the variants; intervals are not "
        "corrected.",
        columns=("variant", *map(found.shown, tasks), "IQM", "minimum", "harmonic mean", f"P(> {baseline})", "p"),
        rows=tuple(rows),
    )


def _compared(found: Results, harmonic: dict[str, Any]) -> dict[str, tuple[Estimate | None, float | None]]:
    """Each variant against the baseline, on the seeds that both have."""
    baseline = found.study.baseline
    if baseline not in harmonic:
        return {}
    base = dict(zip((one.trial.seed for one in found.of(baseline)), harmonic[baseline], strict=True))
    chances: dict[str, Estimate] = {}
    p_values: dict[str, float] = {}
    for name, values in harmonic.items():
        own = dict(zip((one.trial.seed for one in found.of(name)), values, strict=True))
        both = [seed for seed in own if seed in base]
        if name == baseline or len(both) < 2:
            continue
        one, other = np.asarray([[own[seed]] for seed in both]), np.asarray([[base[seed]] for seed in both])
        chance = statistics.bootstrap_interval(statistics.probability_of_improvement, one, other)
        chances[name] = Estimate(chance.value, chance.low, chance.high, len(both))
        p_values[name] = statistics.sign_flip_test((one - other)[:, 0])
    corrected = dict(zip(p_values, statistics.holm(list(p_values.values())), strict=True)) if p_values else {}
    return {name: (chances[name], corrected[name]) for name in chances}


def _decision(found: Results) -> Table | None:
    """Whether each variant is preferred to the baseline by the rule of docs/studies.md, and which condition fails."""
    known = shares_of(found)
    if known is None:
        return None
    harmonic = {name: statistics.harmonic_mean_over_tasks(one) for name, one in known.by_variant.items()}
    baseline, rows = found.study.baseline, []
    for name, (chance, p) in _compared(found, harmonic).items():
        own, base = (_by_task(found, one, lambda row: row.mean) for one in (name, baseline))
        below = [
            found.shown(task)
            for task, mine, theirs in zip(found.tasks, own, base, strict=True)
            if None not in (mine, theirs) and None not in (mine.high, theirs.low) and mine.high < theirs.low
        ]
        improves = chance is not None and chance.low is not None and chance.low > 0.5
        significant = p is not None and p < SIGNIFICANT
        verdict = "yes" if improves and significant and not below else "no"
        answers = ["yes" if held else "no" for held in (improves, significant)]
        rows.append((name, *answers, ", ".join(below) or "none", verdict if found.finished else "not finished"))
    if not rows:
        return None
    return Table(
        name="decision",
        title="Decision",
        note=f"By the rule of docs/studies.md a variant is preferred to {baseline} if the interval of P(> {baseline}) "
        f"lies above 0.5, p is below {SIGNIFICANT:g}, and no task's interval of the mean score lies below that of "
        f"{baseline}. A study decides when all its trials have finished.",
        columns=("variant", "interval above 0.5", f"p below {SIGNIFICANT:g}", "tasks below", "preferred"),
        rows=tuple(rows),
    )


def _played(found: Results) -> Table:
    columns = ["variant", "switches", "updates"]
    for what in ("steps", "visits", "updates"):
        columns += [f"{what} {found.shown(task)}" for task in found.tasks]
    rows = []
    for name in found.variants:
        trials = found.of(name)
        rows.append(
            (
                name,
                round(float(np.mean([one.switches for one in trials]))),
                round(float(np.mean([one.updates for one in trials]))),
                *_by_task(found, name, lambda row: row.steps, whole=True),
                *_by_task(found, name, lambda row: row.visits, whole=True),
                *_by_task(found, name, lambda row: row.updates, whole=True),
            )
        )
    return Table(
        name="played",
        title="Steps, visits and updates",
        note="Means over seeds. Updates of a task: those made while it was played; with learning.update_tasks all, "
        "every task's replay has its part in them.",
        columns=tuple(columns),
        rows=tuple(rows),
    )


def _over_training(found: Results) -> Table | None:
    """Area under the curve and forgetting, where training was evaluated."""
    if all(len(row.curve) < 2 for one in found.results for row in one.tasks):
        return None

    def area(row: TaskResult) -> float | None:
        steps, means = [step for step, _ in row.curve], [mean for _, mean in row.curve]
        return float(statistics.area_under_curve(steps, means)) if len(steps) > 1 else None

    def lost(row: TaskResult) -> float | None:
        return float(statistics.forgetting([mean for _, mean in row.curve])) if len(row.curve) > 1 else None

    def lost_with_fresh_statistics(row: TaskResult) -> float | None:
        if row.reestimated is None or len(row.curve) < 2:
            return None
        return float(statistics.forgetting([*(mean for _, mean in row.curve[:-1]), row.reestimated]))

    measures = {"area": area, "lost": lost}
    note = (
        "Of the evaluations during training. Area: mean score over the steps (area under the curve). Lost: best "
        "earlier score minus the final one; a best over noisy evaluations is too high, so compare variants only."
    )
    if any(row.reestimated is not None for one in found.results for row in one.tasks):
        measures["lost, re-estimated"] = lost_with_fresh_statistics
        note += (
            " Re-estimated: with the final network's normalisation statistics re-estimated from the replays (evaluate "
            "--reestimate-batches). What is then not lost was not forgotten by the weights."
        )
    rows = [
        (name, *(value for measure in measures.values() for value in _by_task(found, name, measure)))
        for name in found.variants
    ]
    columns = ("variant", *(f"{measure} {found.shown(task)}" for measure in measures for task in found.tasks))
    return Table(name="training", title="Over training", note=note, columns=columns, rows=tuple(rows))
