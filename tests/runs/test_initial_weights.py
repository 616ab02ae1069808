"""A run that begins with the weights of another one."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from switchmt_snn import train
from switchmt_snn.cli import main
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.runs.checkpoint import CheckpointStore
from switchmt_snn.runs.packing import pretrained_names

pytestmark = pytest.mark.slow


def config(**changes: Any) -> ExperimentConfig:
    data: dict[str, Any] = {
        "total_steps": 300,
        "tasks": {"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"], "num_envs": 2},
        "network": {"hidden_units": 16, "timesteps": 2},
        "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 400},
        "evaluation": {"episodes": 1, "max_episode_steps": 50},
        "recording": {"checkpoint_every_steps": 100},
    }
    for key, value in changes.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) else value
    return from_dict(data)


def weights(run: Path, step: int) -> dict[str, torch.Tensor]:
    found, tensors = CheckpointStore(run / "checkpoints").load_model()
    assert found == step
    return tensors


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(config(), tmp_path_factory.mktemp("source") / "run").path


def equal(some: dict[str, torch.Tensor], others: dict[str, torch.Tensor]) -> bool:
    return some.keys() == others.keys() and all(torch.equal(some[name], others[name]) for name in some)


def test_a_run_begins_with_the_weights_of_another(source: Path, tmp_path: Path) -> None:
    learns_later = config(seed=5, total_steps=60, initial_weights=str(source), learning={"learning_starts_steps": 100})
    run = train(learns_later, tmp_path / "run").path
    assert equal(weights(run, 60), weights(source, 300))
    assert not equal(
        weights(train(replace(learns_later, initial_weights=None), tmp_path / "own").path, 60), weights(run, 60)
    )
    recorded = json.loads((run / "environment.json").read_text())["initial_weights"]
    assert (recorded["run"], recorded["step"], len(recorded["sha256"])) == (str(source), 300, 64)


def test_it_learns_on_from_there_and_resumes_without_the_other_run(source: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(source, tmp_path / "copy")
    asked = config(seed=5, initial_weights=str(copy), network={"surrogate": "fast_sigmoid"})
    whole = train(asked, tmp_path / "whole").path
    assert not equal(weights(whole, 300), weights(source, 300))
    half = train(replace(asked, total_steps=100), tmp_path / "half").path
    shutil.rmtree(copy)
    train(asked, half)
    assert equal(weights(half, 300), weights(whole, 300))


def test_before_its_first_checkpoint_it_begins_again_with_the_same_weights(source: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(source, tmp_path / "copy")
    asked = config(seed=5, total_steps=100, initial_weights=str(copy))
    whole = train(asked, tmp_path / "whole").path
    again = shutil.copytree(whole, tmp_path / "again")
    shutil.rmtree(again / "checkpoints")
    (again / "checkpoints").mkdir()
    train(asked, again)
    assert equal(weights(again, 100), weights(whole, 100))
    shutil.rmtree(again / "checkpoints")
    train(config(total_steps=400), copy)
    with pytest.raises(ConfigError, match=r"no longer those that .*again began with \(step 300\), expected the same"):
        train(asked, again)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tasks": {"names": ["Acrobot-v1", "CartPole-v1"]}}, "tasks.names"),
        ({"tasks": {"names": ["CartPole-v1"]}}, "tasks.names"),
        ({"tasks": {"frame_stack": 2}}, r"tasks.frame_stack \(1 -> 2\)"),
        ({"network": {"hidden_units": 32}}, r"network.hidden_units \(16 -> 32\)"),
        ({"network": {"timesteps": 4}}, r"network.timesteps \(2 -> 4\)"),
    ],
)  # fmt: skip
def test_weights_of_other_tasks_or_networks_are_refused(
    changes: dict[str, Any], said: str, source: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=rf"other settings: {said}.*expected the same tasks and the same network"):
        train(config(initial_weights=str(source), **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_name_that_is_no_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(
        RunFolderError, match=r"initial_weights is .*nothing .*expected a run folder or one of pretrained"
    ):
        train(config(initial_weights=str(tmp_path / "nothing")), tmp_path / "run")
    with pytest.raises(SystemExit) as stop:
        main(["train", "cartpole", "--initial-weights", "pretrained/pang", "--run", str(tmp_path / "run")])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "no pretrained run 'pang'" in said
    names = ", ".join(f"pretrained/{name}" for name in pretrained_names())
    assert f"expected a run folder or one of {names}" in said


def test_a_pretrained_network_learns_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "--total-steps 400 --evaluation.episodes 2 --learning.learning-starts-steps 1000"
    run = str(tmp_path / "run")
    with pytest.raises(SystemExit) as stop:
        main(["train", "cartpole", "--initial-weights", "pretrained/cartpole", *words.split(), "--run", run])
    said = capsys.readouterr()
    assert stop.value.code == 0, said.err
    assert "begins with the weights of pretrained/cartpole" in said.out + said.err
