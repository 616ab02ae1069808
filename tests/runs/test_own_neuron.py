"""A neuron from outside the package trains, continues and evaluates; what does not know it refuses it by name."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.errors import ConfigError, ExportError
from switchmt_snn.export import ExportSettings, export

ROOT = Path(__file__).parents[2]
MODULE = '''
"""A neuron with a learned reset and two state variables; and a class that is no neuron."""
import torch

from switchmt_snn.spiking.neurons import NeuronLayer


class PartialReset(NeuronLayer):
    """A spike removes a learned share of the membrane and raises the threshold of the next step."""

    STATE = ("membrane", "fatigue")

    def __init__(self, config):
        super().__init__(config)
        self.threshold = config.threshold
        self.share = torch.nn.Parameter(torch.tensor(0.75))

    def step(self, current_t, state):
        membrane, fatigue = state
        fired = self.surrogate(membrane - self.threshold - fatigue).detach()
        membrane = (1.0 - self.share.clamp(0, 1) * fired) * membrane + current_t
        fatigue = 0.5 * fired
        return self.surrogate(membrane - self.threshold - fatigue), (membrane, fatigue)


class NoNeuron:
    pass
'''


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of ``own_neurons.py``, importable here and in child processes."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "own_neurons.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT)]))
    yield folder
    sys.modules.pop("own_neurons", None)


def own_config(**network: object) -> ExperimentConfig:
    return from_dict(
        {
            "name": "own-neuron",
            "total_steps": 400,
            "threads": 1,
            "device": "cpu",
            "tasks": {"suite": "minatar", "names": ["breakout", "asterix"]},
            "network": {
                "hidden_units": 16,
                "timesteps": 3,
                "threshold": 0.25,
                "neuron": "own_neurons:PartialReset",
                **network,
            },
            "learning": {
                "batch_size": 8,
                "learning_starts_steps": 50,
                "replay_capacity_steps": 600,
                "update_every_steps": 4,
                "epsilon_decay_steps": 300,
            },
            "switching": {"max_stay_steps": 100},
            "evaluation": {"episodes": 1, "num_envs": 1},
        }
    )


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(max(run.glob("checkpoints/step-*")) / "model.safetensors")


@pytest.mark.slow
def test_an_own_neuron_trains_continues_in_another_process_and_evaluates(module: Path, tmp_path: Path) -> None:
    config = own_config()
    train(config, run=tmp_path / "whole")
    train(replace(config, total_steps=200), run=tmp_path / "parts")
    command = [sys.executable, "-m", "switchmt_snn", "train", "--run", str(tmp_path / "parts"), "--total-steps", "400"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False, cwd=ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    shares = [name for name in whole if name.endswith("neurons.share")]
    assert len(shares) == 3, "one layer of the trunk, two streams"
    assert all(float(whole[name]) != 0.75 for name in shares), "parameters of an own neuron are trained"
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    assert "neuron: own_neurons:PartialReset" in (tmp_path / "whole" / "config.yaml").read_text()

    evaluation = evaluate(tmp_path / "whole", save=False)
    assert {row.task for row in evaluation.tasks} == {"breakout", "asterix"}
    agent = load_agent(tmp_path / "whole")
    observations = np.zeros((1, *agent.suite.observation_shape), np.uint8)
    assert agent.q_values(observations, "asterix").shape == (1, len(agent.suite.action_names))


@pytest.mark.slow
def test_what_does_not_know_an_own_neuron_refuses_it_by_name(module: Path, tmp_path: Path) -> None:
    config = own_config()
    native = replace(config, learning=replace(config.learning, engine="native"))
    with pytest.raises(ConfigError, match=r"no code for network\.neuron=own_neurons:PartialReset"):
        train(native, run=tmp_path / "native")
    train(replace(config, total_steps=60), run=tmp_path / "run")
    for settings in (ExportSettings(onnx=True, nir=False), ExportSettings(onnx=False, nir=True)):
        with pytest.raises(ExportError, match="own_neurons:PartialReset"):
            export(tmp_path / "run", settings=settings)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_neurons:NoNeuron", "expected a subclass of switchmt_snn.spiking.neurons.NeuronLayer"),
        ("own_neurons:Missing", "has no 'Missing'; check the spelling"),
        ("no_such_module:Neuron", "importing 'no_such_module' fails"),
        ("Quadratic", "expected one of IF, LIF, Synaptic, ALIF, or a class as package.module:Name"),
    ],
)
def test_a_name_that_is_no_neuron_is_refused(module: Path, tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"network.neuron is '{name}', .*{message}"):
        train(own_config(neuron=name), run=tmp_path / "run")
