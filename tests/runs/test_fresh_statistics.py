"""Re-estimated statistics in a run folder: one network is evaluated and stored, also after a crash."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from switchmt_snn import load_agent, train
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.learning.events import Event, Stepped
from switchmt_snn.runs import run as runs

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
        "evaluation": {"episodes": 1, "every_steps": 60},
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
