"""The network that acts in training is the one that is stored as the run's model, evaluated, and kept as the best."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.runs.checkpoint import CheckpointStore
from switchmt_snn.runs.evaluations import Evaluations
from switchmt_snn.runs.packing import pack

STEPS = 600


def config(acting_network: str, total_steps: int = STEPS) -> ExperimentConfig:
    """A target network that is copied every 70 updates, so that at the end it differs from the online network."""
    return from_dict(
        {
            "total_steps": total_steps,
            "threads": 1,
            "tasks": {"suite": "gym", "names": ["CartPole-v1"], "num_envs": 2},
            "network": {"hidden_units": 8, "timesteps": 2, "mlp_normalization": "batch"},
            "learning": {
                "acting_network": acting_network,
                "next_statistics": "batch",
                "reestimate_statistics_batches": 2,
                "learning_starts_steps": 50,
                "batch_size": 8,
                "update_every_steps": 2,
                "replay_capacity_steps": 600,
                "target_update_every_updates": 70,
                "epsilon_decay_steps": 200,
            },
            "evaluation": {"episodes": 4, "epsilon": 0.0, "every_steps": 200},
            "recording": {"checkpoint_every_steps": 100},
        }
    )


def stored(run: Path) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """The model and the other network of the last checkpoint."""
    newest = CheckpointStore(run / "checkpoints").paths()[0]
    training = load_file(newest / "training.safetensors")
    prefixes = ("learner/network/", "learner/target/")
    found = {prefix for prefix in prefixes if any(name.startswith(prefix) for name in training)}
    assert len(found) == 1, "one of the two networks is the model"
    prefix = found.pop()
    return load_file(newest / "model.safetensors"), {
        name.removeprefix(prefix): tensor for name, tensor in training.items() if name.startswith(prefix)
    }


@pytest.mark.slow
@pytest.mark.parametrize("whose", ["online", "target"])
def test_the_model_of_a_checkpoint_is_the_network_that_acts(whose: str, tmp_path: Path) -> None:
    networks: dict[str, dict[str, torch.Tensor]] = {}

    class Look:
        """Keeps the learner's two networks as they are when training ends."""

        def start(self, training, folder, resumed_at):  # type: ignore[no-untyped-def]
            self.learner = training.learner

        def __call__(self, event):  # type: ignore[no-untyped-def]
            pass

        def note(self, text):  # type: ignore[no-untyped-def]
            pass

        def stop(self):  # type: ignore[no-untyped-def]
            for name, network in (("online", self.learner.network), ("target", self.learner.target)):
                networks[name] = {key: value.clone() for key, value in network.state_dict().items()}

    train(config(whose), tmp_path / "run", observers=[Look()])
    model, other = stored(tmp_path / "run")
    (othername,) = {"online", "target"} - {whose}
    for tensors, name in ((model, whose), (other, othername)):
        assert tensors.keys() == networks[name].keys()
        assert all(torch.equal(tensors[key], networks[name][key]) for key in tensors), name
    assert not all(torch.equal(model[key], other[key]) for key in model), "a test of two equal networks shows nothing"

    in_training = Evaluations(tmp_path / "run" / "evaluations").mean_returns(STEPS, config(whose).evaluation)
    assert evaluate(tmp_path / "run", save=False).score("CartPole-v1").mean == in_training["CartPole-v1"]
    packed = load_agent(pack(tmp_path / "run", tmp_path / "packed"))
    assert all(torch.equal(model[key], value) for key, value in packed.network.state_dict().items())


@pytest.mark.slow
def test_the_best_weights_are_the_acting_network_s(tmp_path: Path) -> None:
    wanted = config("target")
    train(wanted, tmp_path / "run")
    best = CheckpointStore(tmp_path / "run" / "checkpoints").best()
    assert best is not None
    scored = Evaluations(tmp_path / "run" / "evaluations").mean_returns(best.step, wanted.evaluation)["CartPole-v1"]
    assert evaluate(tmp_path / "run", checkpoint="best", save=False).score("CartPole-v1").mean == scored


@pytest.mark.slow
@pytest.mark.parametrize("stored_as", ["online", "target"])
def test_such_a_run_continues_exactly(stored_as: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also from a checkpoint of a version in which the model was always the online network."""
    wanted = config("target")
    wanted = replace(wanted, evaluation=replace(wanted.evaluation, every_steps=None))
    train(wanted, tmp_path / "whole")
    save = CheckpointStore.save
    with monkeypatch.context() as patched:
        patched.setattr(CheckpointStore, "save", lambda *all_but_last: save(*all_but_last[:-1], stored_as))
        train(replace(wanted, total_steps=300), tmp_path / "parts")
    train(wanted, tmp_path / "parts")
    for whole, parts in zip(stored(tmp_path / "whole"), stored(tmp_path / "parts"), strict=True):
        assert whole.keys() == parts.keys()
        assert all(torch.equal(whole[key], parts[key]) for key in whole)
