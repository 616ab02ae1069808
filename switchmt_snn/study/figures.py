"""The figures of a study beside its learning curves: performance profiles, what was forgotten, the switches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from switchmt_snn.drawing.chart import Chart, Series, Span, Timeline
from switchmt_snn.drawing.numbers import digits
from switchmt_snn.study import statistics
from switchmt_snn.study.grid import Study
from switchmt_snn.study.results import TaskResult, TrialResult
from switchmt_snn.study.tables import Results, shares_of
from switchmt_snn.viewing.report.figures import STEPS
from switchmt_snn.viewing.report.switching import switching_figures

THRESHOLDS = tuple(number / 20 for number in range(20))
"""Shares of a reference at which profiles are drawn; no share is above 1."""

Figures = list[Chart | Timeline]


def study_figures(study: Study, results: Sequence[TrialResult]) -> dict[str, Figures]:
    """The figures that the finished trials allow, by the title of their section of the page."""
    found = Results(study, results)
    made = {
        "Performance profiles": _profiles(found),
        "What was forgotten": _forgotten(found),
        "Switching": _switching(found),
    }
    return {title: figures for title, figures in made.items() if figures}


def _profiles(found: Results) -> Figures:
    """A chart per variant, beside the baseline."""
    shares = shares_of(found)
    baseline = found.study.baseline
    if shares is None or baseline not in shares.by_variant:
        return []
    note = "Share of all seeds and tasks above each share of its reference; higher is better. Bands: 95 % bootstrap."
    lines = {name: _profile(name, share) for name, share in shares.by_variant.items()}
    return [
        Chart(
            name=f"profile_{name}",
            title=f"{name} and {baseline}",
            x_label="share of the reference",
            series=(replace(line, colour=0), replace(lines[baseline], colour=1)),
            note=note,
            y_range=(0.0, 1.0),
            y_percent=True,
        )
        for name, line in lines.items()
        if name != baseline
    ]


def _profile(name: str, shares_SK: Any) -> Series:
    """A performance profile with a band at each threshold; no band with one seed."""
    values = statistics.performance_profile(shares_SK, THRESHOLDS)
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    if len(shares_SK) > 1:
        bounds = [statistics.bootstrap_interval(partial(_above, threshold), shares_SK) for threshold in THRESHOLDS]
        low, high = tuple(one.low for one in bounds), tuple(one.high for one in bounds)
    label = f"{name} ({len(shares_SK)} seeds)"
    return Series(label, THRESHOLDS, tuple(float(value) for value in values), "line", low, high)


def _above(threshold: float, shares_SK: Any) -> Any:
    return statistics.performance_profile(shares_SK, [threshold])[..., 0]


def _forgotten(found: Results) -> Figures:
    """A matrix of tasks and evaluations per variant."""
    scales = {task: _scale(found, task) for task in found.tasks}
    return [matrix for name in found.variants for matrix in [_matrix(found, name, scales)] if matrix is not None]


def _scale(found: Results, task: str) -> tuple[float, float]:
    """What counts as nothing and as all of a task: random play, and the best evaluation of any variant's mean curve."""
    rows = [row for one in found.results for row in one.tasks if row.task == task]
    means = [mean for row in rows for _, mean in row.curve]
    random = [row.random_mean for row in rows if row.random_mean is not None]
    best = [
        max(float(np.mean(point)) for point in zip(*curves, strict=True))
        for name in found.variants
        for curves in [_curves(found.rows(name, task))[1]]
        if curves and curves[0]
    ]
    floor = float(np.mean(random)) if random else min(means, default=0.0)
    return floor, max(best, default=floor)


def _curves(rows: Sequence[TaskResult]) -> tuple[list[int], list[list[float]]]:
    """The steps at which every seed was evaluated, and each seed's means there."""
    curves = [dict(row.curve) for row in rows]
    steps = sorted(set.intersection(*(set(curve) for curve in curves))) if curves else []
    return steps, [[curve[step] for step in steps] for curve in curves]


def _matrix(found: Results, name: str, scales: dict[str, tuple[float, float]]) -> Timeline | None:
    """What each task had lost at each evaluation since its best one; mean over seeds."""
    spans = []
    end = 0.0
    for index, task in enumerate(found.tasks):
        steps, curves = _curves(found.rows(name, task))
        floor, best = scales[task]
        if len(steps) < 2 or best <= floor:
            continue
        for place in range(1, len(steps)):
            lost = float(np.mean([statistics.forgetting(curve[: place + 1]) for curve in curves]))
            share = min(max(lost / (best - floor), 0.0), 1.0)
            title = f"{task}, step {steps[place]:,}: {digits(lost)} below the best earlier evaluation ({share:.0%})"
            spans.append(Span(index, steps[place - 1], steps[place], share, title))
        end = max(end, float(steps[-1]))
    if not spans:
        return None
    note = (
        "At each evaluation: best earlier score minus the score there, mean over seeds; the darker, the larger the "
        "share of what the task's best variant reached above random play. The last column is the final evaluation."
    )
    return Timeline(
        f"forgotten_{name}",
        f"{name}: lost since the best evaluation",
        STEPS,
        tuple(map(found.shown, found.tasks)),
        tuple(spans),
        end,
        note,
    )


def _switching(found: Results) -> Figures:
    """When each variant's first seed played which task, and the numbers that decided."""
    return [
        replace(figure, name=f"{figure.name}_{name}", title=f"{name}, seed {first.trial.seed}: {figure.title}")
        for name in found.variants
        for first in found.of(name)[:1]
        for figure in switching_figures(first.run)
    ]
