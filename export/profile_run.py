"""Profile a run: recorded play, counts, energy by target, chips, files. Used by the command line and Python."""

from __future__ import annotations

import csv
import io
import itertools
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.drawing.files import figure_files
from switchmt_snn.errors import ConfigError
from switchmt_snn.export.chips.fit import check_fit, layer_shapes
from switchmt_snn.export.chips.precision import effect_of_precision
from switchmt_snn.export.counts.network import TaskCounter, TaskCounts
from switchmt_snn.export.counts.nir_file import count_nir
from switchmt_snn.export.energy.estimate import Energy, Target, estimate
from switchmt_snn.export.energy.traffic import ann_traffic, traffic
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.files import obstacles
from switchmt_snn.export.parity.activity import chunks
from switchmt_snn.export.provenance import provenance
from switchmt_snn.export.recording import Recording, play_in_pieces, recorded_plays
from switchmt_snn.export.report.figures import energy_figure, rates_figures, spikes_figure
from switchmt_snn.export.report.page import Frames, render_report
from switchmt_snn.export.report.sample import take_sample
from switchmt_snn.export.report.verdict import silent_layers, verdict
from switchmt_snn.export.selection import Selection
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.runs.environment import command_line
from switchmt_snn.runs.files import json_text, made, write_atomically, writing
from switchmt_snn.runs.packing import open_run
from switchmt_snn.runs.trained import load_agent
from switchmt_snn.tasks.registry import suite_of

MAX_DECISIONS = 10**7
KEPT_DECISIONS = 4000
"""Recorded decisions per task that are held and stored; of more, counts are made while they are played."""
SCHEMA = 2
"""Version of ``profile.json`` (docs/energy.md); goes up when a field changes its meaning."""


@dataclass(frozen=True)
class ProfileResult:
    """A profile that was written.

    Attributes:
        folder: where ``profile.json``, ``layers.csv`` and ``report.html`` lie.
        facts: the content of ``profile.json``.
        frames: frames of each task's stretch of play, for the report.
    """

    folder: Path
    facts: dict[str, Any]
    frames: Frames


@as_when_started()
def profile(
    run: str | Path | None = None,
    decisions: int = 1000,
    checkpoint: str = "last",
    out: str | Path | None = None,
    targets: Sequence[str | Path] = (),
) -> ProfileResult:
    """Count what a run's network does on recorded decisions of each task; write JSON, CSV and an HTML report.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        decisions: recorded decisions per task, rounded up to a multiple of the copies that are recorded.
        checkpoint: ``last`` or ``best``.
        out: where; None takes the run's ``profile/`` folder.
        targets: names of built-in energy targets or chips, or YAML files of either; empty takes all built-in ones.

    Raises:
        ConfigError: fewer than one decision, or a target or chip that does not exist or is wrong.
        ExportError: recorded play that cannot be read or does not fit, or a weight that is not finite.

    Examples:
        >>> from switchmt_snn.export import profile
        >>> counted = profile("runs/mine", decisions=8, targets=["cmos45-fp32"])
        >>> [task["task"] for task in counted.facts["tasks"]]
        ['CartPole-v1', 'Acrobot-v1']
    """
    if not 1 <= decisions <= MAX_DECISIONS:
        raise ConfigError(f"decisions is {decisions}, expected 1 to {MAX_DECISIONS:,}")
    selection = Selection.of(targets)
    run_folder = open_run(run)
    agent = load_agent(run_folder.path, checkpoint, "cpu")
    network = fold_agent(agent)  # refuses weights that are not finite before anything is played
    if not network.spiking:
        selection = Selection(tuple(t for t in selection.targets if "mac" in t.operations_pj), ())
    run_folder = open_run(run_folder.path, to_write=True)
    folder = _folder(Path(out) if out is not None else run_folder.path / "profile")
    recordings = list(recorded_plays(agent, run_folder.path / "recordings", min(decisions, KEPT_DECISIONS)))
    profiles = tuple(_counted(agent, k, recording, decisions) for k, recording in enumerate(recordings))
    fits = [check_fit(layer_shapes(network), chip).to_dict() for chip in selection.chips]
    # Rounded weights are played by an ONNX graph in memory; nothing else of a profile needs one.
    no_graph = obstacles(network).get("onnx") if fits else None
    bits = sorted({fit["weight_bits"] for fit in fits}) if no_graph is None else []
    tasks, frames = [], []
    decisions_per_s = suite_of(agent.config.tasks).decisions_per_s
    for index, (recording, counted) in enumerate(zip(recordings, profiles, strict=True)):
        sample = take_sample(agent, index, recording)
        frames.append(sample.frames)
        evaluation = run_folder.evaluations.best_known(agent.step, recording.task)
        tasks.append(
            _task_facts(counted, selection.targets, evaluation, decisions_per_s)
            | {
                "most_frequent_action_share": float(np.bincount(recording.actions).max() / len(recording.actions)),
                "gains": _gains(agent, index),
                "precision": [_precision(agent, index, width, recording) for width in bits],
                "sample": sample.to_dict(),
            }
        )
    settings = agent.config.network
    facts = {
        **provenance(run_folder.path),
        "run": run_folder.path.resolve().name,
        "method": settings.method,
        "encoding": settings.encoding,
        "timesteps": settings.timesteps,
        "training_step": agent.step,
        "decisions_per_s": decisions_per_s,
        "protocol": {r.task: {"epsilon": r.epsilon, "seed": r.seed} for r in recordings},
        "chips": fits,
        "precision_left_out": no_graph,
    }
    return _written(folder, profiles, selection.targets, facts, tasks, tuple(frames))


@as_when_started()
def profile_file(
    file: str | Path,
    observations: str | Path,
    out: str | Path | None = None,
    targets: Sequence[str | Path] = (),
    reset: str | None = None,
    fires_at_threshold: bool = False,
) -> ProfileResult:
    """``profile`` of a NIR file on stored observations (``switchmt_snn.export.counts.nir_file.count_nir``).

    Args:
        file: a NIR graph.
        observations: an .npz file.
        out: where; None takes ``FILE-profile/`` beside the file.
        targets: as in ``profile``; chips are for runs only.
        reset: see ``count_nir``.
        fires_at_threshold: see ``count_nir``.

    Raises:
        ConfigError: a target that is not one.
        ExportError: a file that cannot be read or does not fit.
    """
    selection, path = Selection.of(targets), Path(file)
    if targets and selection.chips:
        names = ", ".join(chip.name for chip in selection.chips)
        raise ConfigError(f"{names} is a chip, expected energy targets for a NIR file; chips are checked for runs")
    counted = count_nir(path, Path(observations), reset, fires_at_threshold)
    counts = counted.counts
    folder = _folder(Path(out) if out is not None else path.with_name(f"{path.stem}-profile"))
    facts = {**provenance(), "run": path.name, "timesteps": counts.timesteps}
    facts |= {"chips": [], "precision_left_out": None, "decisions_per_s": None}
    facts |= {"convention": asdict(counted.convention), "doubts": list(counted.doubts)}
    tasks = [_task_facts(counts, selection.targets, None, None)]
    return _written(folder, (counts,), selection.targets, facts, tasks, ())


def compare_profiles(profiles: Iterable[ProfileResult], out: str | Path | None = None) -> Path:
    """Several profiles in one report; ``comparison.json`` and ``comparison.html`` beside the first one's files.

    Returns:
        Path of the report.
    """
    compared = list(profiles)
    folder = _folder(Path(out)) if out is not None else compared[0].folder
    command, runs = command_line(), [profile.facts for profile in compared]
    facts = {"schema": SCHEMA, "command": command, "runs": runs}
    write_atomically(folder / "comparison.json", json_text(facts, indent=1).encode())
    page = folder / "comparison.html"
    write_atomically(page, render_report(runs, [profile.frames for profile in compared], command).encode())
    return page


def _folder(folder: Path) -> Path:
    """Make a folder, and see that it can be written to before anything is computed."""
    with writing(made(folder, "--out"), "--out"), tempfile.TemporaryFile(dir=folder):
        return folder


def _written(
    folder: Path,
    profiles: tuple[TaskCounts, ...],
    targets: tuple[Target, ...],
    facts: dict[str, Any],
    tasks: list[dict[str, Any]],
    frames: Frames,
) -> ProfileResult:
    energies = [(target, estimate(task, target)) for task in profiles for target in targets]
    summary = _summary(profiles, energies)
    facts = {
        "schema": SCHEMA,
        "headline": " ".join([*facts.get("doubts", ()), _headline(profiles, [energy for _, energy in energies])]),
        "command": command_line(),
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        **facts,
        "verdict": verdict(tasks),
        "warnings": silent_layers(tasks, profiles[0].spiking),
        "spiking": profiles[0].spiking,
        "summary": summary,
        "targets": {target.name: asdict(target) for target in targets},
        "tasks": tasks,
    }
    figures = [one for one in (energy_figure(facts), spikes_figure(facts), *rates_figures(facts)) if one is not None]
    facts["figures"] = [asdict(figure) for figure in figures]
    write_atomically(folder / "profile.json", json_text(facts, indent=1).encode())
    write_atomically(folder / "layers.csv", _layers_csv(profiles).encode())
    for name, content in figure_files(figures).items():
        write_atomically(made(folder / "figures") / name, content)
    write_atomically(folder / "report.html", render_report([facts], [frames], facts["command"]).encode())
    return ProfileResult(folder, facts, frames)


def _task_facts(
    task: TaskCounts,
    targets: tuple[Target, ...],
    evaluation: dict[str, Any] | None,
    decisions_per_s: float | None,
) -> dict[str, Any]:
    energies = []
    for target in targets:
        energy = estimate(task, target)
        rates = {
            "per_episode_pj": None if evaluation is None else energy.total_pj * evaluation["decisions_per_episode"],
            "power_uw": None if decisions_per_s is None else energy.total_pj * decisions_per_s * 1e-6,
        }
        energies.append(energy.to_dict() | rates)
    facts = task.to_dict()
    for layer, plain in zip(task.layers, facts["layers"], strict=True):
        plain["accesses"] = asdict(traffic(layer, task.spiking))
        plain["ann_accesses"] = asdict(ann_traffic(layer))
    return facts | {"evaluation": evaluation, "energy": energies}


def _counted(agent: Agent, task: int, recording: Recording, decisions: int) -> TaskCounts:
    """Counts on the recording, or on play that begins like it and is not kept."""
    counter = TaskCounter(agent, task)
    pieces: Iterable[npt.NDArray[Any]]
    if decisions <= KEPT_DECISIONS:
        decisions, pieces = len(recording.observations), chunks(recording.observations)
    else:
        played = play_in_pieces(agent, recording.task, decisions, recording.epsilon, recording.seed)
        pieces = (piece.reshape(-1, *agent.suite.observation_shape) for piece, _, _ in played)
    with progress_of(f"counting {recording.task}", decisions, "decisions") as progress:
        for piece in pieces:
            counter.add(piece)
            progress.advance(len(piece))
    return counter.counts()


def _gains(agent: Agent, task: int) -> dict[str, dict[str, float]]:
    """The dendrites' gains of a task by stream; empty without dendrites."""
    gains: dict[str, dict[str, float]] = {}
    for name, stream in agent.network.streams.items():
        dendrites: Any = stream.dendrites
        if dendrites is not None:
            with torch.no_grad():
                gain: torch.Tensor = dendrites(task)
            gains[name] = {"mean": float(gain.mean()), "smallest": float(gain.min()), "largest": float(gain.max())}
    return gains


def _precision(agent: Agent, task: int, bits: int, recording: Recording) -> dict[str, Any]:
    effect = effect_of_precision(agent, task, bits, recording.observations)
    return {
        "bits": bits,
        "decisions": effect.decisions,
        "equal_actions_share": effect.equal_actions_share,
        "decisions_with_flips": effect.decisions_with_flips if agent.network.spiking else None,
        "largest_q_difference": effect.largest_q_difference,
    }


def _summary(tasks: tuple[TaskCounts, ...], energies: list[tuple[Target, Energy]]) -> dict[str, Any]:
    """Smallest and largest over tasks and targets, and by chip: several sources for one chip give a range."""
    chips: dict[str, list[Energy]] = {}
    for target, energy in energies:
        chips.setdefault(target.chip, []).append(energy)
    return {
        "spikes": _range([task.spikes for task in tasks]),
        "rate": _range([task.rate for task in tasks]),
        "spikes_per_synapse": _range([task.spikes_per_synapse for task in tasks]),
        "total_pj": _range([energy.total_pj for _, energy in energies]),
        "by_ann": _range([energy.by_ann for _, energy in energies]),
        "by_quantised_ann": _range([energy.by_quantised_ann for _, energy in energies]),
        "chips": {
            chip: _range([energy.total_pj for energy in of_chip])
            | {
                "sources": len({energy.target for energy in of_chip}),
                "all_priced": not any(energy.not_included for energy in of_chip),
                "by_ann": _range([energy.by_ann for energy in of_chip]),
            }
            for chip, of_chip in chips.items()
        },
    }


def _range(values: Iterable[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    return {"smallest": min(known, default=None), "largest": max(known, default=None)}


def _headline(tasks: tuple[TaskCounts, ...], energies: list[Energy]) -> str:
    """Whether the network costs less than the ANN of its shape, after what makes such a number worthless."""
    dead = [
        f"{layer.name} in {task.task}"
        for task in tasks
        for layer in task.layers
        if layer.neurons and layer.silent == layer.neurons
    ]
    warning = f"No neuron fires in {', '.join(dead)}: Q does not depend on what is seen there. " if dead else ""
    if not tasks[0].spiking:
        return warning + "This is an ANN; its effective counts leave out what a zero activation saves."
    compared = [(energy, energy.by_ann) for energy in energies if energy.by_ann is not None]
    if not energies:
        return warning + "No energy target was chosen: counts and chips only."
    if not compared:
        return (
            warning + "None of these targets prices all of the network and its ANN twin: no word on which costs less."
        )
    worse = [f"{energy.task} on {energy.target}" for energy, ratio in compared if ratio > 1]
    ratios = [ratio for _, ratio in compared]
    span = (
        f"{min(ratios):.2f} to {max(ratios):.2f} of the ANN of its shape, by task and target (estimates; dense ANN, "
        "weights reused on neither side)"
    )
    costs = f"costs MORE than the ANN: {', '.join(worse)}; in all, {span}" if worse else f"costs {span}"
    return f"{warning}The spiking network {costs}."


def _layers_csv(tasks: tuple[TaskCounts, ...]) -> str:
    """One row per task, layer and simulation step."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["task", "layer", "operation", "step", "decisions", "effective", "active_inputs", "spikes"])
    for task in tasks:
        for layer in task.layers:
            # Under direct encoding the first layer's synapses work once, its neurons at every step.
            columns = (layer.effective_T, layer.active_inputs_T, layer.spikes_T)
            for step, counts in enumerate(itertools.zip_longest(*columns, fillvalue=0)):
                writer.writerow([task.task, layer.name, layer.operation, step, layer.decisions, *counts])
    return text.getvalue()
