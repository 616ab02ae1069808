"""Several runs side by side: those that differ in their seed only are one group, drawn as a mean and a band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from switchmt_snn.config import differences
from switchmt_snn.drawing.chart import Chart, Reference, Series
from switchmt_snn.viewing.names import shown_task
from switchmt_snn.viewing.progress import RETURN_WINDOW_EPISODES
from switchmt_snn.viewing.report.curves import on_grid, running_means
from switchmt_snn.viewing.report.figures import STEPS
from switchmt_snn.viewing.report.sources import Sources

GRID = 120
"""Places along the steps at which runs are averaged."""
_SAME = ("seed", "name", "total_steps", "device", "threads")
"""Settings that do not part groups: who draws, what it is called, how long it goes on, and on what."""
_MOST_KEYS = 3


@dataclass(frozen=True)
class Group:
    """Runs of one config but for the seed."""

    label: str
    runs: tuple[Sources, ...]


def grouped(runs: Sequence[Sources]) -> tuple[list[Group], dict[str, list[Any]]]:
    """The groups in order of their first run, and the settings in which they differ with each group's value."""
    parts: list[list[Sources]] = []
    for run in runs:
        for part in parts:
            if not set(differences(part[0].config, run.config)) - {*_SAME}:
                part.append(run)
                break
        else:
            parts.append([run])
    differing = differing_settings(parts)
    labels = [_label(part[0], differing, index) for index, part in enumerate(parts)]
    if len(set(labels)) < len(labels):
        labels = [f"{label} ({part[0].folder.path.name})" for label, part in zip(labels, parts, strict=True)]
    return [Group(label, tuple(part)) for label, part in zip(labels, parts, strict=True)], differing


def differing_settings(parts: Sequence[Sequence[Sources]]) -> dict[str, list[Any]]:
    """The settings in which groups of runs differ, with each group's value."""
    firsts = [part[0].config for part in parts]
    keys = [key for one in firsts for key in differences(firsts[0], one) if key not in _SAME]
    return {key: [_value(one, key) for one in firsts] for key in sorted(dict.fromkeys(keys), key=_weight)}


def _weight(key: str) -> tuple[bool, bool, str]:
    """The method first, then the tasks."""
    return key != "network.method", not key.startswith("tasks."), key


def _value(config: Any, key: str) -> Any:
    for name in key.split("."):
        config = getattr(config, name)
    return list(config) if isinstance(config, tuple) else config


def _label(run: Sources, differing: dict[str, list[Any]], index: int) -> str:
    method = run.config.network.method
    keys = [key for key in differing if key not in ("network.method", "tasks.names")]
    if not keys:
        return method
    if len(keys) > _MOST_KEYS:
        return f"{method} {run.config.name}"
    return f"{method} " + ", ".join(f"{key.rpartition('.')[2]} {differing[key][index]}" for key in keys)


def all_tasks(groups: Sequence[Group]) -> tuple[str, ...]:
    """Every task that a run has, in order of appearance."""
    return tuple(dict.fromkeys(task for group in groups for run in group.runs for task in run.tasks))


def comparison_figures(groups: Sequence[Group]) -> list[Chart]:
    """A chart per task: each group's running mean of returns, its smallest and largest over seeds as a band."""
    charts = []
    for number, task in enumerate(all_tasks(groups), 1):
        series = [one for index, group in enumerate(groups) for one in _band(group, task, index)]
        if series:
            charts.append(
                Chart(
                    name=f"comparison_{number}",
                    title=f"Raw return in {shown_task(task, all_tasks(groups))}",
                    x_label=STEPS,
                    series=tuple(series),
                    references=_random(groups, task),
                    note=f"Mean over seeds of the mean of {RETURN_WINDOW_EPISODES} episodes; band: smallest to largest "
                    "seed, to the end of the shortest run of a group.",
                )
            )
    return charts


def _band(group: Group, task: str, index: int) -> list[Series]:
    curves = []
    for run in group.runs:
        episodes = run.episodes_of(run.tasks.index(task)) if task in run.tasks else []
        if episodes:
            means = running_means([one.episode_return for one in episodes], RETURN_WINDOW_EPISODES)
            curves.append(([float(one.step) for one in episodes], means))
    if not curves:
        return []
    first, last = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = np.linspace(first, max(first, last), GRID)
    values = np.stack([on_grid(x, y, grid) for x, y in curves])
    known = np.isfinite(values).all(axis=0)
    grid, values = grid[known], values[:, known]
    band = len(curves) > 1
    label = f"{group.label} ({len(curves)} seeds)" if band else group.label
    low, high = (tuple(each.tolist()) if band else () for each in (values.min(axis=0), values.max(axis=0)))
    return [Series(label, tuple(grid.tolist()), tuple(values.mean(axis=0).tolist()), "line", low, high, index)]


def _random(groups: Sequence[Group], task: str) -> tuple[Reference, ...]:
    means = [
        found["rows"]["random"]["mean"]
        for group in groups
        for run in group.runs
        for found in [run.newest_evaluation(task)]
        if found is not None and "random" in found["rows"]
    ]
    return (Reference("random, measured", float(np.mean(means))),) if means else ()


def comparison_facts(
    groups: Sequence[Group], differing: dict[str, list[Any]], charts: Sequence[Chart]
) -> dict[str, Any]:
    """Everything that the page of a comparison says: the content of comparison.json."""
    return {
        "format": 1,
        "groups": [
            {"label": group.label, "runs": [run.folder.path.resolve().name for run in group.runs]} for group in groups
        ],
        "differing": differing,
        "runs": [{**run.summary.to_dict(), "group": group.label} for group in groups for run in group.runs],
        "scores": [
            {"task": task, "group": group.label, **facts}
            for task in all_tasks(groups)
            for group in groups
            for facts in [_scores(group, task)]
            if facts is not None
        ],
        "figures": {"learning": [asdict(chart) for chart in charts]},
    }


def _scores(group: Group, task: str) -> dict[str, Any] | None:
    """Over seeds: the newest evaluations, or the newest training returns of runs without one."""
    kinds = {
        kind: [
            score.mean for run in group.runs for score in run.summary.scores if (score.task, score.of) == (task, kind)
        ]
        for kind in ("evaluation", "training")
    }
    kind = "evaluation" if kinds["evaluation"] else "training"
    values = kinds[kind]
    if not values:
        return None
    spread = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return {
        "of": kind,
        "seeds": len(values),
        "mean": float(np.mean(values)),
        "standard_error": spread,
        "smallest": min(values),
        "largest": max(values),
    }
