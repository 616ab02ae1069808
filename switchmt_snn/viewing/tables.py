"""Tables of evaluations and descriptions for the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from rich import box
from rich.table import Table

from switchmt_snn.acting.evaluation import Evaluation, TaskScore
from switchmt_snn.drawing.numbers import bytes_of, compact, duration, scaled
from switchmt_snn.machine.memory import GIB
from switchmt_snn.runs.description import MethodDescription
from switchmt_snn.runs.listing import RunSummary
from switchmt_snn.tasks.registry import find_suite
from switchmt_snn.tasks.suite import Suite

HEADING = 12
"""Characters in a line of a heading."""


def _table(title: str, caption: str | None = None) -> Table:
    """A table for 80 columns with names of usual length; in a narrower place, texts wrap and numbers stay whole."""
    return Table(
        title=title,
        caption=caption,
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )


def _add_columns(table: Table, left: tuple[str, ...], right: tuple[str, ...]) -> None:
    for name in left:
        table.add_column(name, overflow="fold")
    for name in right:
        table.add_column(_broken(name), justify="right", no_wrap=True)


def _broken(name: str) -> str:
    """A heading over several lines of at most 12 characters, if its parts are no longer: a task's name is not cut."""
    lines = [""]
    for part in re.split(r"(?<=[-_/:. ])", name):
        if lines[-1] and len(lines[-1] + part) > HEADING:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def evaluation_table(evaluation: Evaluation) -> Table:
    """Task by task: the agent, the random policy, and what the suite knows from publications."""
    table = _table(f"Scores at step {evaluation.step:,}", str(evaluation.protocol))
    _add_columns(table, ("task", "policy"), ("mean", "± s.e.", "median", "human", "steps", "mean Q", "n"))
    suite = find_suite(evaluation.protocol.suite)
    for task in dict.fromkeys(row.task for row in evaluation.tasks):
        for row in evaluation.tasks:
            if row.task == task:
                table.add_row(*_score_cells(row))
        reference = suite.references.get(task)
        for policy, _, mean in published_rows(suite, [task]):
            normalized = None if reference is None else reference.normalized(mean)
            table.add_row(task, policy, f"{mean:.1f}", "", "", _percent(normalized), "", "", "")
        table.add_section()
    return table


def published_rows(suite: type[Suite], tasks: list[str]) -> list[tuple[str, str, float]]:
    """Published raw scores of a suite's tasks: (policy, task, mean)."""
    return [(row.policy, task, row.scores[task]) for row in suite.published for task in tasks if task in row.scores]


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.0%}"


def _score_cells(row: TaskScore) -> list[str]:
    return [
        row.task,
        row.policy,
        f"{row.mean:.2f}",
        "" if row.standard_error is None else f"{row.standard_error:.2f}",
        f"{row.median:.1f}",
        _percent(row.human_normalized),
        f"{row.mean_length_steps:,.0f}",
        "" if row.mean_q is None else f"{row.mean_q:.3f}",
        str(row.episodes),
    ]


def runs_table(runs: Sequence[RunSummary]) -> Table:
    """Run folders, one a row; ``runs`` is not empty."""
    table = _table(
        f"Runs in {runs[0].path.parent}",
        "scores: mean of the newest evaluation; * of the newest training returns, where there is no evaluation",
    )
    _add_columns(table, ("run", "method", "status"), ("steps", "time", "size"))
    table.add_column("scores", overflow="fold")
    for run in runs:
        scores = "\n".join(
            f"{score.task} {score.mean:.4g}{'*' if score.of == 'training' else ''}" for score in run.scores
        )
        left_out = [task for task in run.tasks if task not in {score.task for score in run.scores}]
        done = f"{run.steps / run.total_steps:.0%}" if run.status != "finished" else ""
        table.add_row(
            run.path.name,
            run.method,
            f"{run.status} {done}".strip(),
            compact(run.steps),
            duration(run.seconds),
            bytes_of(run.bytes),
            "\n".join([scores, *left_out]).strip(),
        )
    return table


def parity_table(parity: dict[str, Any]) -> Table:
    """What ``export`` compared: exact numbers, recorded play, other simulators (the content of parity.json)."""
    spiking = any(row["flipped_spikes"] for row in parity["dyadic"] + parity["recorded"])
    flipping = ", where rounding near a threshold may flip a spike; flips: decisions with at least one"
    bitwise = "every spike and every Q-value" if spiking else "every Q-value"
    table = _table(
        "Parity with the trained network",
        f"exact: a copy whose sums do not round. play: real weights on recorded play{flipping if spiking else ''}; "
        f"actions: share of equal ones, |dQ|: largest difference. bitwise: {bitwise}.",
    )
    _add_columns(table, ("check", "task", "runtime"), ("n", "flips", "|dQ|", "actions", "bitwise"))
    for check, rows in (("exact", parity["dyadic"]), ("play", parity["recorded"])):
        for row in rows:
            share, flips = row["equal_actions_share"], row["decisions_with_flips"]
            flipped = f"{flips:,}" if row["flipped_spikes"] else "-"
            difference = f"{row['largest_q_difference']:.1e}" if row["largest_q_difference"] else "0"
            numbers = (
                f"{row['decisions']:,}",
                flipped,
                difference,
                f"{share:.1%}" if share < 1 else "all",
                _yes(row["bitwise"]),
            )
            table.add_row(check, row["task"], row["runtime"], *numbers)
    for row in parity["simulators"]:
        n = f"{row['decisions']:,}"
        verdict = "refused" if row["refused"] else _yes(row["bitwise"])
        table.add_row("exact", row["task"], row["simulator"], n, "", "", "", verdict)
    return table


def profile_table(task: dict[str, Any]) -> Table:
    """What a network does per decision in one task, layer by layer (an entry of ``tasks`` in profile.json)."""
    mean, twin = task["per_decision"], task["twins"]["ann"]["macs"]
    spiking = bool(mean["neuron_updates"])
    if spiking:
        facts = [f"{mean['acs']:,.0f} accumulations and {mean['macs']:,.0f} multiplications; the ANN twin multiplies"]
        facts.append(f"{twin:,} times. {mean['spikes']:,.0f} spikes, {task['spikes_per_synapse']:.3f} per synapse.")
    else:
        facts = [f"{mean['macs']:,.0f} multiplications of inputs that are not zero, of {twin:,} in all."]
        facts.append(f"{mean['spikes']:,.0f} active units (above zero).")
    table = _table(f"{task['task']}: per decision, mean of {task['decisions']:,}", " ".join(facts))
    share = "rate" if spiking else "active"
    _add_columns(table, ("layer", "kind"), ("effective", "dense", "neurons", share, "silent", "saturated"))
    for layer in task["layers"]:
        counts = (f"{layer['effective_per_decision']:,.0f}", f"{layer['dense_per_decision']:,}")
        neurons = (f"{layer['neurons']:,}", f"{layer['rate']:.4f}", f"{layer['silent']:,}", f"{layer['saturated']:,}")
        table.add_row(layer["name"], layer["operation"], *counts, *(neurons if layer["neurons"] else [""] * 4))
    return table


def energy_table(profile: dict[str, Any]) -> Table:
    """Energy per decision by target and task (the content of profile.json)."""
    tasks = profile["tasks"]
    ratios = {"x ANN": "by_ann", "x QANN": "by_quantised_ann"} if profile["spiking"] else {"x dense": "by_ann"}
    meaning = (
        "x ANN: by the ANN of the same shape on the same target, the task with the most; x QANN: by the same with "
        "activations of few bits; above 1 the spiking network costs more."
        if profile["spiking"]
        else "x dense: by the same ANN if no zero saves anything, the task with the most."
    )
    table = _table(
        "Energy per decision: compute, and memory where the target has a memory model",
        f"{meaning} * something counted has no price there (report.html says what, and what each target leaves out). "
        "How: est(imated), sim(ulated), rep(orted), mea(sured).",
    )
    _add_columns(table, ("target", "how"), (*(task["task"] for task in tasks), *ratios))
    for index, target in enumerate(profile["targets"].values()):
        rows = [task["energy"][index] for task in tasks]
        cells = [f"{_energy(row['total_pj'])}{'*' if row['not_included'] else ''}" for row in rows]
        for twin in ratios.values():
            known = [row[twin] for row in rows if row[twin] is not None]
            cells.append(f"{max(known):.2f}" if known else "")
        table.add_row(target["name"], target["evidence"][:3] + ".", *cells)
    return table


def fit_table(profile: dict[str, Any]) -> Table:
    """Which chips hold the network, the layer that is furthest over a limit, and what rounding weights does."""
    effects = [
        f"{effect['equal_actions_share']:.1%} in {task['task']}"
        for task in profile["tasks"]
        for effect in task["precision"]
    ]
    bits = ", ".join(dict.fromkeys(str(chip["weight_bits"]) for chip in profile["chips"]))
    rounding = f"Same action with weights of {bits} bits: {', '.join(effects)}."
    if profile["precision_left_out"] is not None:
        rounding = f"What weights of {bits} bits do to the actions is left out: {profile['precision_left_out']}."
    title = "Will it fit? Public limits of memory and size, layer by layer (all of them: report.html)"
    table = _table(title, rounding)
    _add_columns(table, ("chip", "fits", "tightest"), ())
    table.add_column("needs, of what there is")
    for chip in profile["chips"]:
        limits = [(layer["layer"], limit) for layer in chip["layers"] for limit in layer["limits"]]
        limits += [("whole chip", limit) for limit in chip["limits"]]
        where, limit = max(limits, key=lambda pair: pair[1]["needs"] / pair[1]["has"])
        needs, has = (_three_digits(limit[key]) for key in ("needs", "has"))
        unit = "" if limit["unit"] == limit["resource"] else f" {limit['unit']},"
        amount = f"{needs} of {has}{unit} {limit['resource']}"
        missing = [(layer["layer"], layer["not_held"]) for layer in chip["layers"] if layer["not_held"]]
        if missing:
            where, amount = missing[0][0], f"not held: {missing[0][1]}"
        table.add_row(chip["chip"], _yes(chip["fits"]), where, amount)
    return table


def comparison_table(profiles: list[dict[str, Any]]) -> Table:
    """Several runs side by side, a column each."""
    table = _table("Per decision, smallest to largest over tasks and targets")
    table.add_column("")
    for profile in profiles:
        table.add_column(profile["run"], justify="right")
    for label, key, show, kinds in (
        ("spikes", "spikes", _three_digits, (True,)),
        ("per neuron and step", "rate", _three_digits, (True,)),
        ("active units (ANN)", "spikes", _three_digits, (False,)),
        ("energy", "total_pj", _energy, (True, False)),
        ("x ANN", "by_ann", _three_digits, (True, False)),
        ("x QANN", "by_quantised_ann", _three_digits, (True,)),
    ):
        if any(profile["spiking"] in kinds for profile in profiles):
            cells = (_span(one["summary"][key], show) if one["spiking"] in kinds else "" for one in profiles)
            table.add_row(label, *cells)
    return table


def _energy(value_pj: float) -> str:
    return scaled(value_pj * 1e-12, "J")


def _span(values: dict[str, float | None], show: Callable[[float], str]) -> str:
    known = [show(value) for value in values.values() if value is not None]
    return " to ".join(dict.fromkeys(known))


def _three_digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _yes(holds: bool) -> str:
    return "yes" if holds else "no"


def methods_table(methods: dict[str, MethodDescription], source: str) -> Table:
    """One row per method; ``source`` names the config."""
    table = _table(
        f"Methods under the config {source}",
        "ops: dense synaptic operations per decision, in millions; T: simulation steps",
    )
    _add_columns(table, ("method",), ("parameters", "neurons", "T", "ops (M)", "GiB"))
    table.add_column("switching", no_wrap=True)
    for method in methods.values():
        table.add_row(
            method.method,
            f"{method.trainable_parameters:,}",
            f"{method.neurons:,}",
            str(method.timesteps),
            f"{method.dense_operations_per_decision / 1e6:,.2f}",
            f"{method.memory.total_bytes / GIB:.2f}",
            method.switching_policy,
        )
    return table


def layers_table(method: MethodDescription) -> Table:
    """The layers of one method."""
    memory = method.memory
    parts = (
        f"memory: replay {memory.replay_bytes / GIB:.2f} GiB, networks and optimiser {memory.network_bytes / GIB:.2f}, "
        f"snapshots {memory.switching_bytes / GIB:.2f}, activations {memory.activations_bytes / GIB:.2f}, "
        f"writing a checkpoint {memory.checkpoint_bytes / GIB:.2f}, the process itself {memory.process_bytes / GIB:.2f}"
    )
    if method.deployed_parameters != method.trainable_parameters:
        trained, deployed = method.trainable_parameters, method.deployed_parameters
        parts += f"; {trained:,} parameters are trained, {deployed:,} decide for a task"
    table = _table(f"Layers of {method.method}", parts)
    _add_columns(table, ("layer",), ("input", "output", "parameters", "neurons", "ops/step", "steps"))
    for layer in method.layers:
        table.add_row(
            layer.name,
            "x".join(map(str, layer.input_shape)),
            "x".join(map(str, layer.output_shape)),
            f"{layer.parameters:,}",
            f"{layer.neurons:,}",
            f"{layer.operations_per_step:,}",
            str(layer.steps),
        )
    return table
