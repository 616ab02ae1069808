"""Profile a run: recorded play, counts, energy by target, chips, files. Used by the command line and Python."""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from switchmt_snn.errors import ConfigError, ExportError, did_you_mean
from switchmt_snn.export.energy import DECISIONS_PER_S, Energy, Target, builtin_targets, estimate, load_target
from switchmt_snn.export.fit import CHIPS, check_fit, layer_shapes
from switchmt_snn.export.fold import fold
from switchmt_snn.export.nir_profile import profile_nir
from switchmt_snn.export.precision import effect_of_precision
from switchmt_snn.export.profile import TaskProfile, profile_task
from switchmt_snn.export.provenance import provenance
from switchmt_snn.export.recording import Recording, recorded_plays
from switchmt_snn.export.report import Frames, render_report
from switchmt_snn.export.sample import take_sample
from switchmt_snn.learning.agent import Agent
from switchmt_snn.learning.files import write_atomically
from switchmt_snn.learning.run import load_agent
from switchmt_snn.learning.run_folder import RunFolder, command_line, latest_run

SCHEMA = 2
"""Version of ``profile.json`` (docs/energy.md); goes up when a field changes its meaning."""


@dataclass(frozen=True)
class Profile:
    """A profile that was written.

    Attributes:
        folder: where ``profile.json``, ``layers.csv`` and ``report.html`` lie.
        facts: the content of ``profile.json``.
        frames: frames of each task's stretch of play, for the report.
    """

    folder: Path
    facts: dict[str, Any]
    frames: Frames


@dataclass(frozen=True)
class Selection:
    """What to price and what to fit: energy targets and chips."""

    targets: tuple[Target, ...]
    chips: tuple[str, ...]

    @classmethod
    def of(cls, names: tuple[str, ...]) -> Selection:
        """Built-in targets, chips and YAML files by name; none names all built-in ones.

        Raises:
            ConfigError: no such target or chip, or a file that is not a target.
        """
        known = builtin_targets()
        if not names:
            return cls(tuple(known.values()), tuple(CHIPS))
        for name in names:
            if name not in (*known, *CHIPS) and Path(name).suffix not in (".yaml", ".yml"):
                raise ConfigError(f"unknown target {name!r}{did_you_mean(name, (*known, *CHIPS))}")
        priced = [name for name in names if name in known or name not in CHIPS]
        return cls(tuple(load_target(name) for name in priced), tuple(name for name in names if name in CHIPS))


def profile(
    run: str | Path | None = None,
    decisions: int = 1000,
    checkpoint: str = "last",
    out: str | Path | None = None,
    targets: tuple[str, ...] = (),
) -> Profile:
    """Count what a run's network does on recorded decisions of each task; write JSON, CSV and an HTML report.

    Args:
        run: run folder; None takes the newest under ``runs/``.
        decisions: recorded decisions per task, at least.
        checkpoint: ``last`` or ``best``.
        out: where; None takes the run's ``profile/`` folder.
        targets: names of built-in targets or chips, or YAML files; empty takes all built-in ones.

    Raises:
        ConfigError: fewer than one decision, or a target that is not one.
        ExportError: recorded play that cannot be read or does not fit, or a weight that is not finite.
    """
    if decisions < 1:
        raise ConfigError(f"decisions is {decisions}, expected at least 1")
    selection = Selection.of(targets)
    run_folder = RunFolder(Path(run) if run is not None else latest_run()).require()
    agent = load_agent(run_folder.path, checkpoint, "cpu")
    network = fold(agent)  # refuses weights that are not finite before anything is played
    folder = _folder(Path(out) if out is not None else run_folder.path / "profile")
    recordings = list(recorded_plays(agent, run_folder.path / "recordings", decisions))
    profiles = tuple(profile_task(agent, k, recording.observations) for k, recording in enumerate(recordings))
    fits = [check_fit(layer_shapes(network), chip).to_dict() for chip in selection.chips]
    bits = sorted({fit["weight_bits"] for fit in fits})
    tasks, frames = [], []
    for index, (recording, counted) in enumerate(zip(recordings, profiles, strict=True)):
        sample = take_sample(agent, index, recording)
        frames.append(sample.frames)
        episode_decisions = _decisions_per_episode(run_folder.path, agent.step, recording.task)
        tasks.append(
            _task_facts(counted, selection.targets, episode_decisions)
            | {
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
        "protocol": {r.task: {"epsilon": r.epsilon, "seed": r.seed} for r in recordings},
    }
    return _written(folder, profiles, selection.targets, facts | {"chips": fits}, tasks, tuple(frames))


def profile_file(
    file: str | Path, observations: str | Path, out: str | Path | None = None, targets: tuple[str, ...] = ()
) -> Profile:
    """:func:`profile` of a NIR file on stored observations (:func:`switchmt_snn.export.nir_profile.profile_nir`).

    Args:
        file: a NIR graph.
        observations: an .npz file.
        out: where; None takes ``FILE-profile/`` beside the file.
        targets: as in :func:`profile`; chips are for runs only.

    Raises:
        ConfigError: a target that is not one.
        ExportError: a file that cannot be read or does not fit.
    """
    selection, path = Selection.of(targets), Path(file)
    counted = profile_nir(path, Path(observations))
    folder = _folder(Path(out) if out is not None else path.with_name(f"{path.stem}-profile"))
    facts = {**provenance(), "run": path.name, "timesteps": counted.timesteps, "chips": []}
    return _written(folder, (counted,), selection.targets, facts, [_task_facts(counted, selection.targets, None)], ())


def compare_profiles(profiles: Iterable[Profile], out: str | Path | None = None) -> Path:
    """Several profiles in one report; ``comparison.json`` and ``comparison.html`` beside the first one's files.

    Returns:
        Path of the report.
    """
    compared = list(profiles)
    folder = _folder(Path(out)) if out is not None else compared[0].folder
    command, runs = command_line(), [profile.facts for profile in compared]
    facts = {"schema": SCHEMA, "command": command, "runs": runs}
    write_atomically(folder / "comparison.json", json.dumps(facts, indent=1).encode())
    page = folder / "comparison.html"
    write_atomically(page, render_report(runs, [profile.frames for profile in compared], command).encode())
    return page


def _folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExportError(f"{folder} cannot be made ({error.strerror}), expected a folder; use --out") from error
    return folder


def _written(
    folder: Path,
    profiles: tuple[TaskProfile, ...],
    targets: tuple[Target, ...],
    facts: dict[str, Any],
    tasks: list[dict[str, Any]],
    frames: Frames,
) -> Profile:
    energies = [(target, estimate(task, target)) for task in profiles for target in targets]
    summary = _summary(profiles, energies)
    facts = {
        "schema": SCHEMA,
        "headline": _headline(profiles[0].spiking, [energy for _, energy in energies]),
        "command": command_line(),
        **facts,
        "decisions_per_s": DECISIONS_PER_S,
        "summary": summary,
        "targets": {target.name: asdict(target) for target in targets},
        "tasks": tasks,
    }
    write_atomically(folder / "profile.json", json.dumps(facts, indent=1).encode())
    write_atomically(folder / "layers.csv", _layers_csv(profiles).encode())
    write_atomically(folder / "report.html", render_report([facts], [frames], facts["command"]).encode())
    return Profile(folder, facts, frames)


def _task_facts(task: TaskProfile, targets: tuple[Target, ...], episode_decisions: float | None) -> dict[str, Any]:
    energies = []
    for target in targets:
        energy = estimate(task, target)
        per_episode = None if episode_decisions is None else energy.total_pj * episode_decisions
        energies.append(energy.to_dict() | {"per_episode_pj": per_episode})
    return task.to_dict() | {"decisions_per_episode": episode_decisions, "energy": energies}


def _decisions_per_episode(run: Path, step: int, task: str) -> float | None:
    """Mean length of the agent's episodes in the newest evaluation at this training step; None without one."""
    found = sorted((run / "evaluations").glob(f"step-{step:012d}_*.json"), key=lambda path: path.stat().st_mtime)
    for path in reversed(found):
        for row in json.loads(path.read_bytes())["tasks"]:
            if row["policy"] == "agent" and row["task"] == task:
                return float(row["mean_length_steps"])
    return None


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


def _summary(tasks: tuple[TaskProfile, ...], energies: list[tuple[Target, Energy]]) -> dict[str, Any]:
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
            chip: _range([energy.total_pj for energy in of_chip]) | {"sources": len({e.target for e in of_chip})}
            for chip, of_chip in chips.items()
        },
    }


def _range(values: Iterable[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    return {"smallest": min(known, default=None), "largest": max(known, default=None)}


def _headline(spiking: bool, energies: list[Energy]) -> str:
    """Whether the network costs less than the ANN of its shape, in one sentence."""
    if not spiking:
        return "This is an ANN; its effective counts leave out what a zero activation saves."
    compared = [(energy, energy.by_ann) for energy in energies if energy.by_ann is not None]
    if not compared:
        return "None of these targets can price the ANN twin, so nothing is said about which costs less."
    worse = [f"{energy.task} on {energy.target}" for energy, ratio in compared if ratio > 1]
    ratios = [ratio for _, ratio in compared]
    span = (
        f"{min(ratios):.2f} to {max(ratios):.2f} of the ANN of its shape, by task and target (estimates; dense ANN, "
        "weights reused on neither side)"
    )
    if worse:
        return f"The spiking network costs MORE than the ANN: {', '.join(worse)}; in all, {span}."
    return f"The spiking network costs {span}."


def _layers_csv(tasks: tuple[TaskProfile, ...]) -> str:
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
