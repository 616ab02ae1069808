"""When a run switched between its tasks, and by which number."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from switchmt_snn.drawing.chart import Chart, Series, Span, Timeline
from switchmt_snn.drawing.numbers import digits
from switchmt_snn.learning.switching.criterion import Deciding
from switchmt_snn.runs.history import Decision
from switchmt_snn.viewing.names import shown_task
from switchmt_snn.viewing.report.curves import thinned
from switchmt_snn.viewing.report.figures import STEPS
from switchmt_snn.viewing.report.sources import Sources

MOST_VISITS = 300
"""With more visits the timeline shows each task's share of the steps in equal stretches."""
STRETCHES = 150


@dataclass(frozen=True)
class Visit:
    """A stay on a task, from one step to another; ``left_by`` is None while it lasts."""

    task: int
    begin: int
    end: int
    left_by: Decision | None


def visits(run: Sources) -> list[Visit]:
    """The visits of a run, the running one included."""
    found: list[Visit] = []
    begin, task = 0, 0
    for decision in run.history.decisions:
        if decision.switches:
            found.append(Visit(run.tasks.index(decision.task), begin, decision.step, decision))
            begin, task = decision.step, run.tasks.index(decision.next_task)
    if run.summary.steps > begin:
        found.append(Visit(task, begin, run.summary.steps, None))
    return found


def switching_figures(run: Sources) -> list[Chart | Timeline]:
    """The timeline and a chart of each deciding number; nothing for a run of one task or without decisions."""
    if len(run.tasks) < 2 or not run.history.decisions:
        return []
    return [_timeline(run), *(chart for one in run.deciding for chart in _deciding(run, one))]


def switching_facts(run: Sources) -> dict[str, Any] | None:
    """Visits and reasons in numbers; None where there is no timeline."""
    if len(run.tasks) < 2 or not run.history.decisions:
        return None
    stays = visits(run)
    left = Counter(visit.left_by.reason for visit in stays if visit.left_by is not None)
    return {
        "policy": run.config.switching.policy,
        "visits": len(stays),
        "reasons": [{"reason": reason, "switches": count} for reason, count in left.most_common()],
        "tasks": [
            {
                "task": task,
                "visits": sum(visit.task == index for visit in stays),
                "steps": sum(visit.end - visit.begin for visit in stays if visit.task == index),
            }
            for index, task in enumerate(run.tasks)
        ],
    }


def _timeline(run: Sources) -> Timeline:
    stays, end = visits(run), float(run.summary.steps)
    if len(stays) <= MOST_VISITS:
        spans = [Span(visit.task, visit.begin, visit.end, 1.0, _told(run, visit)) for visit in stays]
        note = "Rest the pointer on a visit: its steps, and what ended it."
    else:
        spans = _shares(run, stays, end)
        note = (
            f"{len(stays):,} visits; the darker, the larger the task's share of a stretch of {end / STRETCHES:,.0f} "
            "steps."
        )
    rows = tuple(shown_task(task, run.tasks) for task in run.tasks)
    return Timeline("switching", "Which task was played", STEPS, rows, tuple(spans), end, note)


def _told(run: Sources, visit: Visit) -> str:
    where = f"{run.tasks[visit.task]}: steps {visit.begin:,} to {visit.end:,}"
    if visit.left_by is None:
        return f"{where}; still there"
    numbers = [
        f"{one.number} {digits(visit.left_by.numbers[one.number])}"
        + ("" if bound is None else f", bound {digits(bound)}")
        for one in run.deciding
        if one.number in visit.left_by.numbers
        for bound in [bound_of(visit.left_by, one)]
    ]
    return "; ".join([where, f"left by {visit.left_by.reason}", *numbers])


def _shares(run: Sources, stays: list[Visit], end: float) -> list[Span]:
    """Each task's share of every stretch."""
    edges = np.linspace(0.0, end, STRETCHES + 1)
    spans = []
    for task, name in enumerate(run.tasks):
        # Steps in the task up to each edge, by interpolation between the borders of its visits.
        borders, steps = [0.0], [0.0]
        for visit in stays:
            borders += [float(visit.end)]
            steps += [steps[-1] + (visit.end - visit.begin if visit.task == task else 0)]
        shares = np.diff(np.interp(edges, borders, steps)) / (end / STRETCHES)
        for begin, stop, share in zip(edges[:-1], edges[1:], shares, strict=True):
            if share > 0:
                title = f"{name}: {share:.0%} of the steps {begin:,.0f} to {stop:,.0f}"
                spans.append(Span(task, float(begin), float(stop), min(1.0, float(share)), title))
    return spans


def bound_of(decision: Decision, deciding: Deciding) -> float | None:
    """What a number was compared with; None if it was not."""
    if not deciding.bound or any(name not in decision.numbers for name in deciding.bound):
        return None
    return math.prod(decision.numbers[name] for name in deciding.bound)


def _deciding(run: Sources, deciding: Deciding) -> list[Chart]:
    """The number at each decision by task, and its bound."""
    rows = [decision for decision in run.history.decisions if deciding.number in decision.numbers]
    if not rows:
        return []
    series = []
    for index, task in enumerate(run.tasks):
        own = [row for row in rows if row.task == task]
        own = [own[i] for i in thinned(len(own))]
        x, y = tuple(row.step for row in own), tuple(row.numbers[deciding.number] for row in own)
        series.append(Series(task, x, y, "points", colour=index))
    bounds = [(row.step, bound) for row in rows for bound in [bound_of(row, deciding)] if bound is not None]
    bounds = [bounds[i] for i in thinned(len(bounds))]
    if bounds:
        x, y = tuple(step for step, _ in bounds), tuple(bound for _, bound in bounds)
        series.append(Series("bound: " + " x ".join(deciding.bound), x, y, "dashed", colour=len(run.tasks)))
    shown = sum(len(one.x) for one in series[: len(run.tasks)])
    note = "At each decision." if shown == len(rows) else f"{shown:,} of {len(rows):,} decisions, evenly taken."
    name = f"deciding_{deciding.number}"
    return [Chart(name, f"What decides: {deciding.number}", STEPS, tuple(one for one in series if one.x), note=note)]
