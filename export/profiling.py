"""Profile a run: recorded play, counts, energy by target, files. Used by the command line and Python."""

from __future__ import annotations

import csv
import io
import itertools
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from switchmt_snn.errors import ConfigError, ExportError
from switchmt_snn.export.energy import Energy, Target, builtin_targets, estimate, load_target
from switchmt_snn.export.profile import TaskProfile, profile_task
from switchmt_snn.export.provenance import provenance
from switchmt_snn.export.recording import recorded_plays
from switchmt_snn.learning.files import write_atomically
from switchmt_snn.learning.run import load_agent
from switchmt_snn.learning.run_folder import RunFolder, latest_run

SCHEMA = 1
"""Version of ``profile.json``; goes up when a field changes its meaning."""


@dataclass(frozen=True)
class Profile:
    """A run's profile: its tasks, their energy by target, and where the numbers come from."""

    folder: Path
    facts: dict[str, Any]
    tasks: tuple[TaskProfile, ...]
    targets: tuple[Target, ...]

    def energies(self, task: TaskProfile) -> list[Energy]:
        """One estimate per target."""
        return [estimate(task, target) for target in self.targets]

    @property
    def headline(self) -> str:
        """Whether the network costs less than the ANN of its shape, in one sentence."""
        compared = [(e, e.by_ann) for task in self.tasks for e in self.energies(task) if e.by_ann is not None]
        if not self.tasks[0].spiking:
            return "This is an ANN; its effective counts leave out what a zero activation saves."
        if not compared:
            return "None of these targets can price the ANN twin, so nothing is said about which costs less."
        worse = [f"{e.task} on {e.target} ({ratio:.2f}x)" for e, ratio in compared if ratio > 1]
        if worse:
            return f"The spiking network costs MORE than the ANN of its shape: {', '.join(worse)}."
        ratios = [ratio for _, ratio in compared]
        return (
            f"The spiking network costs {min(ratios):.2f} to {max(ratios):.2f} of the ANN of its shape, by task and "
            "target (estimates; dense ANN without reuse of weights)."
        )

    def to_dict(self) -> dict[str, Any]:
        """The content of ``profile.json``."""
        tasks = [
            task.to_dict() | {"energy": [energy.to_dict() for energy in self.energies(task)]} for task in self.tasks
        ]
        constants = {target.name: asdict(target) for target in self.targets}
        return {"schema": SCHEMA, "headline": self.headline, **self.facts, "targets": constants, "tasks": tasks}


def profile(
    run: str | Path | None = None,
    decisions: int = 1000,
    checkpoint: str = "last",
    out: str | Path | None = None,
    targets: tuple[str, ...] = (),
) -> Profile:
    """Count what a run's network does on recorded decisions of each task; write ``profile.json`` and ``layers.csv``.

    Args:
        run: run folder; None takes the newest under ``runs/``.
        decisions: recorded decisions per task, at least.
        checkpoint: ``last`` or ``best``.
        out: where; None takes the run's ``profile/`` folder.
        targets: names of built-in targets or YAML files; empty takes all built-in ones.

    Raises:
        ConfigError: fewer than one decision, or a target that is not one.
        ExportError: recorded play that cannot be read or does not fit.
    """
    if decisions < 1:
        raise ConfigError(f"decisions is {decisions}, expected at least 1")
    chosen = tuple(load_target(name) for name in targets) or tuple(builtin_targets().values())
    run_folder = RunFolder(Path(run) if run is not None else latest_run()).require()
    agent = load_agent(run_folder.path, checkpoint, "cpu")
    folder = Path(out) if out is not None else run_folder.path / "profile"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExportError(f"{folder} cannot be made ({error.strerror}), expected a folder; use --out") from error
    recordings = list(recorded_plays(agent, run_folder.path / "recordings", decisions))
    tasks = tuple(profile_task(agent, k, recording.observations) for k, recording in enumerate(recordings))
    settings = agent.config.network
    facts = {
        **provenance(run_folder.path),
        "method": settings.method,
        "encoding": settings.encoding,
        "timesteps": settings.timesteps,
        "training_step": agent.step,
        "protocol": {r.task: {"epsilon": r.epsilon, "seed": r.seed} for r in recordings},
    }
    result = Profile(folder, facts, tasks, chosen)
    write_atomically(folder / "profile.json", json.dumps(result.to_dict(), indent=1).encode())
    write_atomically(folder / "layers.csv", _layers_csv(tasks).encode())
    return result


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
