"""The figures of a run, by section of its page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

from switchmt_snn.config import METHOD_TRAITS
from switchmt_snn.drawing.chart import Chart, Reference, Series
from switchmt_snn.learning.events import LayerHealth, Measured
from switchmt_snn.learning.measuring import HEALTH_BATCH
from switchmt_snn.viewing.names import shown_task
from switchmt_snn.viewing.progress import RETURN_WINDOW_EPISODES
from switchmt_snn.viewing.report.curves import (
    HIGH_PERCENT,
    LOW_PERCENT,
    MOST_POINTS,
    percentiles_by_bin,
    running_means,
    thinned,
)
from switchmt_snn.viewing.report.sources import Sources

STEPS = "agent steps"


def learning_figures(run: Sources) -> list[Chart]:
    """A learning curve per task: returns, their running mean, evaluations, references."""
    return [_learning_curve(run, index) for index in range(len(run.tasks)) if _has_curve(run, index)]


def _has_curve(run: Sources, task: int) -> bool:
    return bool(run.episodes_of(task)) or run.newest_evaluation(run.tasks[task]) is not None


def _learning_curve(run: Sources, task: int) -> Chart:
    name, episodes = run.tasks[task], run.episodes_of(task)
    steps, returns = [one.step for one in episodes], [one.episode_return for one in episodes]
    series, note = [], ""
    if len(episodes) <= MOST_POINTS:
        series.append(Series("episode", tuple(steps), tuple(returns), "dots", colour=task))
    else:
        places, low, middle, high = percentiles_by_bin(steps, returns, run.summary.steps)
        label = f"{LOW_PERCENT}th to {HIGH_PERCENT}th percentile"
        series.append(Series(label, tuple(places), tuple(middle), "band", tuple(low), tuple(high), task))
        note = f"{len(episodes):,} episodes. "
    means = running_means(returns, RETURN_WINDOW_EPISODES)
    kept = thinned(len(means))
    smooth = Series(
        f"mean of {RETURN_WINDOW_EPISODES} episodes",
        tuple(steps[i] for i in kept),
        tuple(means[i] for i in kept),
        colour=task,
    )
    points = [
        (one["step"], row["mean"])
        for one in run.evaluations
        for row in one["tasks"]
        if (row["policy"], row["task"]) == ("agent", name)
    ]
    series.append(smooth)
    if points:
        x, y = tuple(step for step, _ in points), tuple(mean for _, mean in points)
        series.append(Series("evaluation (mean)", x, y, "marks", colour=task + 1))
    return Chart(
        name=f"learning_{task + 1}",
        title=f"Raw return in {shown_task(name, run.tasks)}",
        x_label=STEPS,
        series=tuple(one for one in series if one.x),
        references=tuple(_references(run, name)),
        note=note,
    )


def _references(run: Sources, task: str) -> Iterator[Reference]:
    """Random play as it was measured (else as published), a human, and the published score of the run's method."""
    evaluation = run.newest_evaluation(task)
    measured = None if evaluation is None else evaluation["rows"].get("random")
    if measured is not None:
        yield Reference("random, measured", measured["mean"])
    for row in () if run.suite is None else run.suite.published:
        wanted = row.policy.startswith(f"{run.config.network.method} (") or row.policy.startswith("human (")
        if task in row.scores and (wanted or (measured is None and row.policy.startswith("random ("))):
            yield Reference(row.policy, row.scores[task])


def training_figures(run: Sources) -> list[Chart]:
    """Epsilon, loss, mean Q and speed."""
    rows = [run.history.measured[i] for i in thinned(len(run.history.measured))]
    x = tuple(row.step for row in rows)
    speed_x, speed_y = _speeds(run)
    loss = Series("mean since the row before", x, tuple(row.loss for row in rows))
    q = Series("mean Q(s, a) of sampled transitions", x, tuple(row.q for row in rows))
    speed = Series("agent steps per second", tuple(speed_x), tuple(speed_y))
    charts = [
        Chart("epsilon", "Exploration (epsilon)", STEPS, tuple(_epsilons(run)), y_range=(0.0, None)),
        Chart("loss", f"Loss ({run.config.learning.loss})", STEPS, (loss,), y_range=(0.0, None)),
        Chart("q", "Q-values", STEPS, (q,)),
        Chart("speed", "Speed", STEPS, (speed,), y_range=(0.0, None)),
    ]
    return [chart for chart in charts if any(value is not None for series in chart.series for value in series.y)]


def _epsilons(run: Sources) -> Iterator[Series]:
    """Epsilon at the ends of episodes, by task if each task has its own clock."""
    if run.config.learning.epsilon_clock == "total":
        groups = {"epsilon": list(run.history.episodes)}
    else:
        groups = {task: run.episodes_of(index) for index, task in enumerate(run.tasks)}
    for index, (name, episodes) in enumerate(groups.items()):
        kept = [episodes[i] for i in thinned(len(episodes))]
        if kept:
            x, y = tuple(one.step for one in kept), tuple(one.epsilon for one in kept)
            yield Series(name, x, y, colour=index)


_SPEEDS = 100


def _speeds(run: Sources) -> tuple[list[float], list[float]]:
    """Steps per second between moments of one call, at the later one."""
    x, y = [], []
    most = max(2, _SPEEDS // max(1, len(run.history.calls)))
    for call in run.history.calls:
        for before, now in pairwise([call[i] for i in thinned(len(call), most)]):
            if now.wall_s > before.wall_s and now.step > before.step:
                x.append(float(now.step))
                y.append((now.step - before.step) / (now.wall_s - before.wall_s))
    return x, y


MOST_TASKS = 4
"""With more tasks, charts of layers do not part them."""


def layer_figures(run: Sources) -> list[Chart]:
    """Activity, dead and saturated share of each layer over training, for each task that was played then."""
    spiking = METHOD_TRAITS[run.config.network.method].spiking
    kinds: list[tuple[str, str, bool, Callable[[LayerHealth], float]]] = [
        ("rate", "Spikes per neuron and step" if spiking else "Mean activity", False, lambda layer: layer.rate),
        (
            "dead",
            f"Neurons that fire in none of {HEALTH_BATCH} observations"
            if spiking
            else f"Units that are active in none of {HEALTH_BATCH} observations",
            True,
            lambda layer: layer.dead,
        ),
        (
            "saturated",
            f"Neurons that fire at every step of {HEALTH_BATCH} observations",
            True,
            lambda layer: layer.saturated,
        ),
    ]
    rows = [row for row in run.history.measured if row.layers]
    parts = {"": rows}
    if 1 < len(run.tasks) <= MOST_TASKS:
        parts = {task: [row for row in rows if row.task == index] for index, task in enumerate(run.tasks)}
    return [
        _layers(f"{name}_{number}" if task else name, f"{title}: {task}" if task else title, chosen, share, value)
        for name, title, share, value in kinds
        if spiking or name != "saturated"
        for number, (task, chosen) in enumerate(parts.items(), 1)
        if chosen
    ]


def _layers(name: str, title: str, rows: list[Measured], share: bool, value: Callable[[LayerHealth], float]) -> Chart:
    """A line per layer."""
    rows = [rows[i] for i in thinned(len(rows))]
    x = tuple(row.step for row in rows)
    series = [
        Series(layer, x, tuple(value(row.layers[layer]) if layer in row.layers else None for row in rows))
        for layer in dict.fromkeys(layer for row in rows for layer in row.layers)
    ]
    return Chart(name, title, STEPS, tuple(series), y_range=(0.0, 1.0 if share else None), y_percent=share)
