"""Re-estimated statistics in a run folder: one network is evaluated and stored, also after a crash."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.cli.entry import main
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.errors import CheckpointError, ConfigError, RunFolderError
from switchmt_snn.learning.events import Event, Stepped
from switchmt_snn.runs import run as runs
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.fresh_statistics import with_fresh_statistics
from switchmt_snn.runs.packing import pack

CONFIG: ExperimentConfig = from_dict(
    {
        "total_steps": 200,
        "device": "cpu",
        "tasks": {"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"]},
        "network": {"hidden_units": 8, "timesteps": 2, "mlp_normalization": "batch", "stream_normalization": "batch"},
        "learning": {
            "batch_size": 8,
            "learning_starts_steps": 20,
            "replay_capacity_steps": 500,
            "reestimate_statistics_batches": 3,
        },
        "switching": {"policy": "fixed_steps", "visit_steps": 40},
        "evaluation": {"episodes": 1, "every_steps": 60, "max_episode_steps": 30},
        "recording": {"checkpoint_every_steps": 50},
    }
)


class Crash(Exception):
    pass


class CrashAt:
    """An observer that ends the process's part of a run at a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def __call__(self, event: Event) -> None:
        if isinstance(event, Stepped) and event.step == self.step:
            raise Crash

    def start(self, *_: Any) -> None: ...
    def note(self, text: str) -> None: ...
    def stop(self) -> None: ...


def network_of(run: Path) -> dict[str, torch.Tensor]:
    return load_agent(run).network.state_dict()


def assert_equal(ours: dict[str, torch.Tensor], theirs: dict[str, torch.Tensor]) -> None:
    for name, tensor in theirs.items():
        assert torch.equal(ours[name], tensor), name


@pytest.mark.slow
def test_the_evaluated_network_is_the_stored_one_also_after_crashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluated: list[dict[str, torch.Tensor]] = []
    evaluate = runs.evaluate_agent

    def watched(agent: Any, protocol: Any, **others: Any) -> Any:
        evaluated.append({name: tensor.clone() for name, tensor in agent.network.state_dict().items()})
        return evaluate(agent, protocol, **others)

    monkeypatch.setattr(runs, "evaluate_agent", watched)
    train(CONFIG, tmp_path / "whole")
    assert len(evaluated) == 4
    assert_equal(evaluated[-1], network_of(tmp_path / "whole"))

    def failing(agent: Any, protocol: Any, **others: Any) -> Any:
        if agent.step == 200:
            raise Crash
        return evaluate(agent, protocol, **others)

    for step in (75, 130):  # each after an evaluation that no checkpoint holds
        with pytest.raises(Crash):
            train(CONFIG, tmp_path / "cut", observers=[CrashAt(step)])
    monkeypatch.setattr(runs, "evaluate_agent", failing)
    with pytest.raises(Crash):
        train(CONFIG, tmp_path / "cut")
    monkeypatch.setattr(runs, "evaluate_agent", watched)
    assert train(CONFIG, tmp_path / "cut").status == "finished"
    assert_equal(evaluated[-1], evaluated[3])
    assert_equal(network_of(tmp_path / "cut"), evaluated[3])


def test_statistics_estimated_afterwards_are_those_that_training_would_estimate(tmp_path: Path) -> None:
    run = RunFolder(train(CONFIG, tmp_path / "run").path)
    agent = load_agent(run.path)
    stored = {name: tensor.clone() for name, tensor in agent.network.state_dict().items()}
    assert_equal(with_fresh_statistics(agent, run, 3).network.state_dict(), stored)
    others = with_fresh_statistics(load_agent(run.path), run, 2).network.state_dict()
    changed = {name.rsplit(".", 1)[-1] for name, tensor in others.items() if not torch.equal(tensor, stored[name])}
    assert changed == {"running_mean_KC", "running_var_KC"}


def test_evaluations_with_fresh_statistics_are_kept_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = train(replace(CONFIG, total_steps=60), tmp_path / "run").path
    before = RunFolder(run).evaluations.all()
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", str(run), "--reestimate-batches", "2", "--json"])
    assert ended.value.code == 0
    played = json.loads(capsys.readouterr().out)
    assert played["protocol"]["statistics_batches"] == 2
    assert RunFolder(run).evaluations.all() == before
    (kept,) = RunFolder(run).reestimated_evaluations.all()
    assert kept["tasks"] == played["tasks"]
    assert str(EvaluationProtocol.from_dict(kept["protocol"])).endswith(
        "normalisation statistics re-estimated from 2 batches"
    )


def test_statistics_that_cannot_be_estimated_are_refused_in_one_line(tmp_path: Path) -> None:
    run = RunFolder(train(replace(CONFIG, total_steps=60), tmp_path / "run").path)
    agent = load_agent(run.path)
    agent.step = 40
    with pytest.raises(RunFolderError, match="the weights are of step 40 and the replay is of step 60, expected those"):
        with_fresh_statistics(agent, run, 2)
    with pytest.raises(ConfigError, match="from -1 batches, expected 1 to 1,000,000"):
        evaluate(run.path, reestimate_batches=-1)
    pack(run.path, tmp_path / "packed")
    with pytest.raises(CheckpointError, match="holds weights only"):
        evaluate(tmp_path / "packed", reestimate_batches=2)
    plain = replace(CONFIG.network, mlp_normalization="none", stream_normalization="none")
    learning = replace(CONFIG.learning, reestimate_statistics_batches=0)
    none = train(replace(CONFIG, total_steps=30, network=plain, learning=learning), tmp_path / "none").path
    with pytest.raises(ConfigError, match="the network has no normalisation, expected one whose"):
        evaluate(none, reestimate_batches=2)
    shared = replace(CONFIG.network, normalization="shared")
    one = train(replace(CONFIG, total_steps=30, network=shared, learning=learning), tmp_path / "shared").path
    with pytest.raises(ConfigError, match=r"network\.normalization is shared, expected per_task"):
        evaluate(one, reestimate_batches=2)
