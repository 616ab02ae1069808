"""Weights of another run for a new one to begin with (``initial_weights`` of the config)."""

from __future__ import annotations

import hashlib
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from switchmt_snn.config import ExperimentConfig, differences
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.runs.checkpoint import fitting_weights
from switchmt_snn.runs.folder import read_environment
from switchmt_snn.runs.packing import open_run, pretrained_names
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

OF_TRAINING = (
    "network.surrogate",
    "network.surrogate_slope",
    "network.normalization_momentum",
    "network.neuron_engine",
)
"""Settings of the network that may be another one: they change how it learns, not what it computes."""


@dataclass(frozen=True)
class InitialWeights:
    """Weights and their origin.

    Attributes:
        run: as the config names it.
        step: of the checkpoint.
        weights: of the network that plays (a state dict).
    """

    run: str
    step: int
    weights: dict[str, Tensor]

    def facts(self) -> dict[str, Any]:
        """What environment.json keeps: the run, the step, and the SHA-256 of names and values."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.weights.items()):
            digest.update(name.encode())
            digest.update(tensor.contiguous().numpy().tobytes())
        return {"run": self.run, "step": self.step, "sha256": digest.hexdigest()}

    def give(self, learner: Learner) -> None:
        """Make them the online and the target network's; the optimizer has made no step."""
        state = learner.state_dict()
        own = state["network"].keys()
        with fitting_weights():
            if own != self.weights.keys():
                raise RuntimeError(f"Error(s) in loading state_dict: {sorted(own ^ self.weights.keys())}")
            learner.load_state_dict({**state, "network": self.weights, "target": self.weights})


def read_initial_weights(config: ExperimentConfig, suite: TaskSuite, folder: Path | None) -> InitialWeights | None:
    """The weights that a run of a config begins with; None if they are its own.

    Args:
        config: decided.
        suite: its tasks.
        folder: of the run, if it was begun before but has no checkpoint yet.

    Raises:
        ConfigError: they are of another network or of other tasks, or not those that the run in ``folder`` began with.
        RunFolderError: there is no such run.
        CheckpointError: it has no whole checkpoint.
    """
    run = config.initial_weights
    if run is None:
        return None
    try:
        source = open_run(run)
    except RunFolderError as error:
        names = ", ".join(f"pretrained/{name}" for name in pretrained_names())
        raise RunFolderError(
            f"initial_weights is {run} ({str(error).partition(', expected')[0]}), expected a run folder or one of "
            f"{names}; switchmt-snn runs lists the run folders"
        ) from error
    theirs = source.config()
    changed = {
        key: values
        for key, values in differences(theirs, config).items()
        if (key.startswith("network.") and key not in OF_TRAINING) or key in ("tasks.suite", "tasks.names")
    }
    if not changed and observation_spec(make_suite(theirs.tasks)) != observation_spec(suite):
        changed = {key: values for key, values in differences(theirs, config).items() if key.startswith("tasks.")}
    if changed:
        shown = ", ".join(f"{key} ({old!r} -> {new!r})" for key, (old, new) in sorted(changed.items()))
        raise ConfigError(
            f"initial_weights is {run}, a run with other settings: {shown}; expected the same tasks and the same "
            f"network; begin with its config: switchmt-snn train {shlex.quote(str(source.path / 'config.yaml'))} "
            f"--initial-weights {shlex.quote(run)}"
        )
    step, weights = source.checkpoints().load_model()
    found = InitialWeights(run, step, weights)
    if folder is not None:
        began = read_environment(folder).get("initial_weights")
        if isinstance(began, dict) and began.get("sha256") != found.facts()["sha256"]:
            raise ConfigError(
                f"initial_weights is {run}, whose weights are no longer those that {folder} began with (step "
                f"{began.get('step')}), expected the same ones; start a new run with --run"
            )
    return found
