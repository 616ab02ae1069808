"""Training that ends at an evaluation whose returns are high enough."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn import evaluate, train
from switchmt_snn.cli.entry import main
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.errors import ConfigError


def cartpole_and_car(goals: list[float], total_steps: int = 300, **evaluation: Any) -> ExperimentConfig:
    settings = {"episodes": 2, "every_steps": 100, "stop_at_returns": goals, **evaluation}
    return from_dict(
        {
            "total_steps": total_steps,
            "device": "cpu",
            "tasks": {"suite": "gym", "names": ["CartPole-v1", "MountainCar-v0"]},
            "network": {"hidden_units": 8, "timesteps": 2},
            "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 500},
            "switching": {"policy": "fixed_steps", "visit_steps": 50},
            "evaluation": settings,
        }
    )


def evaluations(run: Path) -> dict[int, list[int]]:
    """The seeds of a run's evaluations, by step."""
    seeds: dict[int, list[int]] = {}
    for path in sorted((run / "evaluations").glob("*.json")):
        stored = json.loads(path.read_text())
        seeds.setdefault(stored["step"], []).append(stored["protocol"]["seed"])
    return seeds


@pytest.mark.slow
def test_training_ends_at_the_first_evaluation_that_reaches_every_goal(tmp_path: Path) -> None:
    """The final scores are of other episodes than those that ended it, and the run is finished."""
    config = cartpole_and_car([5.0, -200.0])  # any policy has these
    result = train(config, tmp_path / "run")
    assert (result.status, result.step) == ("finished", 100)
    assert result.evaluation is not None
    assert result.evaluation.protocol.seed == 10_001
    assert evaluations(tmp_path / "run") == {100: [10_000, 10_001]}
    again = train(config, tmp_path / "run")
    assert (again.status, again.step, again.solved) == ("already_finished", 100, True)


@pytest.mark.slow
def test_the_command_that_trains_a_solved_run_further_does_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A larger budget would not: the goal stays reached."""
    monkeypatch.chdir(tmp_path)
    train(cartpole_and_car([5.0, -200.0], total_steps=120), tmp_path / "my run")
    with pytest.raises(SystemExit):
        main(["train", "--run", "my run"])
    said = capsys.readouterr().out
    assert "already finished at step 100; evaluation.stop_at_returns is reached; begin another run to go on: " in said
    command = shlex.split(said.splitlines()[0].partition(" to go on: ")[2])
    assert command[0] == "switchmt-snn"
    with pytest.raises(SystemExit):
        main(command[1:])
    said = capsys.readouterr().out
    assert "begins with the weights of my run after 100 steps" in " ".join(said.split())
    assert "Scores at step 120" in said


@pytest.mark.slow
def test_training_goes_on_while_one_goal_is_missed(tmp_path: Path) -> None:
    result = train(cartpole_and_car([5.0, -1.0]), tmp_path / "run")  # a mountain car needs 110 steps at least
    assert (result.status, result.step) == ("finished", 300)
    assert evaluations(tmp_path / "run") == {100: [10_000], 200: [10_000], 300: [10_000]}


@pytest.mark.slow
def test_a_solved_run_that_was_cut_off_before_its_last_evaluation_makes_it(tmp_path: Path) -> None:
    config = cartpole_and_car([5.0, -200.0])
    first = train(config, tmp_path / "run")
    for path in (tmp_path / "run" / "evaluations").glob("*_seed10001_*"):
        path.unlink()
    evaluate(tmp_path / "run", config.tasks.names[0], seed=10_001)  # of one task, which is not all of it
    again = train(config, tmp_path / "run")
    assert (again.status, again.step) == ("finished", 100)
    assert first.evaluation is not None
    assert again.evaluation is not None
    assert [row.mean for row in again.evaluation.tasks] == [row.mean for row in first.evaluation.tasks]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"goals": [475.0]}, r"evaluation\.stop_at_returns is \[475\.0\], expected a return for each of"),
        (
            {"goals": [1.0, 1.0], "every_steps": None},
            r"evaluation\.every_steps is None, expected a number of steps with",
        ),
    ],
)
def test_goals_that_cannot_end_a_training_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        cartpole_and_car(**settings)
