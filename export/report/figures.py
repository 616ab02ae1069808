"""The figures of a profile: energy by target and layer, spikes by layer and step, and how often neurons fire."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchmt_snn.drawing.chart import Chart, Series
from switchmt_snn.drawing.rows import LogRows, RowSeries, RowValue
from switchmt_snn.runs.files import file_name

PICOJOULE_PER_MICROJOULE = 1e6
MOST_STEPS = 8
"""As many as there are colours."""


def energy_figure(facts: dict[str, Any]) -> LogRows | None:
    """Microjoule per decision of every target: of each layer, of all, and of the ANN of the same shape.

    A value is the mean over tasks, with their range.

    Args:
        facts: the content of ``profile.json``.

    Returns:
        None without a priced target.
    """
    targets, tasks = list(facts["targets"]), facts["tasks"]
    if not targets:
        return None
    layers = [layer["layer"] for layer in tasks[0]["energy"][0]["layers"]]
    series = [*(RowSeries(name) for name in layers), RowSeries("whole network", "whole")]
    if facts["spiking"]:
        series.append(RowSeries("ANN of the same shape", "other"))
    values = []
    for row in range(len(targets)):
        energies = [task["energy"][row] for task in tasks]
        for index in range(len(layers)):
            values.append(_microjoule(row, index, [energy["layers"][index]["total_pj"] for energy in energies]))
        values.append(_microjoule(row, len(layers), [energy["total_pj"] for energy in energies]))
        twins = [energy["ann_pj"] for energy in energies]
        if facts["spiking"] and None not in twins:
            values.append(_microjoule(row, len(layers) + 1, twins))
    return LogRows(
        name="energy",
        title="Energy per decision by target and layer",
        x_label="energy per decision, µJ",
        rows=tuple(targets),
        series=tuple(series),
        values=tuple(values),
        note=f"{_means(len(tasks))}Targets differ in what they include: single operations, memory, or whole systems.",
    )


def spikes_figure(facts: dict[str, Any]) -> LogRows | None:
    """Spikes per decision of each layer at each simulation step, the mean over tasks with their range.

    Of more than ``MOST_STEPS`` steps some are shown, the first and the last among them.

    Returns:
        None for an ANN.
    """
    tasks, timesteps = facts["tasks"], facts["timesteps"]
    if not facts["spiking"]:
        return None
    shown = sorted({round(step) for step in np.linspace(0, timesteps - 1, min(timesteps, MOST_STEPS))})
    layers = [index for index, layer in enumerate(tasks[0]["layers"]) if layer["neurons"]]
    values = []
    for row, index in enumerate(layers):
        of_tasks = [task["layers"][index] for task in tasks]
        for series, step in enumerate(shown):
            counts = [layer["spikes_T"][step] / layer["decisions"] for layer in of_tasks]
            values.append(_value(row, series, counts))
    return LogRows(
        name="spikes",
        title="Spikes per decision by layer and simulation step",
        x_label="spikes per decision",
        rows=tuple(tasks[0]["layers"][index]["name"] for index in layers),
        series=tuple(RowSeries(f"step {step + 1}") for step in shown),
        values=tuple(values),
        note=_means(len(tasks)),
    )


def rates_figures(facts: dict[str, Any]) -> list[Chart]:
    """For each task a histogram of every layer's neurons by how often they fire; all have the same axes."""
    layers = [(task, [layer for layer in task["layers"] if layer["neurons"]]) for task in facts["tasks"]]
    shares = [[_shares(layer) for layer in of_task] for _, of_task in layers]
    highest = max((max(share) for of_task in shares for share in of_task), default=0.0)
    return [
        Chart(
            name=f"rates_{file_name(task['task'])}",
            title=f"{task['task']}: share of a layer's {'neurons' if facts['spiking'] else 'units'}",
            x_label="spikes per simulation step" if facts["spiking"] else "share of decisions above zero",
            series=tuple(_steps(layer["name"], share) for layer, share in zip(of_task, of_shares, strict=True)),
            y_range=(0.0, highest),
            y_percent=True,
        )
        for (task, of_task), of_shares in zip(layers, shares, strict=True)
    ]


def _shares(layer: dict[str, Any]) -> list[float]:
    return [count / layer["neurons"] for count in layer["rate_histogram"]]


def _steps(name: str, shares: list[float]) -> Series:
    """A histogram from 0 to 1 as a line with steps."""
    edges = np.linspace(0.0, 1.0, len(shares) + 1)
    x = np.repeat(edges, 2)[1:-1]
    return Series(name, tuple(x.tolist()), tuple(np.repeat(shares, 2).tolist()))


def _value(row: int, series: int, values: list[float]) -> RowValue:
    return RowValue(row, series, sum(values) / len(values), min(values), max(values))


def _microjoule(row: int, series: int, values_pj: list[float]) -> RowValue:
    return _value(row, series, [value / PICOJOULE_PER_MICROJOULE for value in values_pj])


def _means(tasks: int) -> str:
    return f"Means over {tasks} tasks, with their range. " if tasks > 1 else ""
