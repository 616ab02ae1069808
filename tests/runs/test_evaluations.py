"""Stored evaluations: none replaces another, and a run's worth is read from the one with the most episodes."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn import evaluate, train
from switchmt_snn.config import EvaluationConfig
from switchmt_snn.config.yaml_io import from_dict
from switchmt_snn.errors import RunFolderError
from switchmt_snn.runs.evaluations import Evaluations
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.listing import summarize

CARTPOLE: dict[str, Any] = {
    "total_steps": 100,
    "threads": 1,
    "tasks": {"suite": "gym", "names": ["CartPole-v1"]},
    "network": {"hidden_units": 8, "timesteps": 2},
    "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 200},
    "evaluation": {"episodes": 4, "num_envs": 2},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("evaluations") / "run"
    train(from_dict(CARTPOLE), run)
    return run


def stored(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (run / "evaluations").iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [{"epsilon": 0.5}, {"epsilon": 0.0500001}, {"num_envs": 1}, {"seed": 3}, {"episodes": 3}, {"max_episode_steps": 5}],
)
def test_an_evaluation_under_another_protocol_leaves_the_others_alone(finished: Path, change: dict[str, Any]) -> None:
    before = stored(finished)
    evaluate(finished, **change)
    after = stored(finished)
    assert len(after) == len(before) + 2
    assert before.items() <= after.items()


@pytest.mark.slow
def test_a_runs_worth_is_the_evaluation_with_the_most_episodes_not_the_newest(finished: Path) -> None:
    evaluate(finished, episodes=1)
    large = evaluate(finished, episodes=6)
    smoke = evaluate(finished, episodes=2)
    evaluations = RunFolder(finished).evaluations
    newest = max(evaluations.folder.glob("*.json"), key=os.path.getmtime)
    assert json.loads(newest.read_bytes())["protocol"]["episodes"] == 2
    known = evaluations.best_known(100, "CartPole-v1")
    assert known is not None
    assert (known["episodes"], known["score"]) == (6, large.score("CartPole-v1").mean)
    assert known["score"] != smoke.score("CartPole-v1").mean
    assert known["protocol"].startswith("6 episodes per task, epsilon 0.05")
    assert evaluations.best_known(99, "CartPole-v1") is None
    assert evaluations.best_known(100, "Acrobot-v1") is None


@pytest.mark.slow
def test_shorter_episodes_replace_nothing_and_count_for_less(finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    evaluations, settings = RunFolder(run).evaluations, RunFolder(run).config().evaluation
    before, known = evaluations.mean_returns(100, settings), evaluations.best_known(100, "CartPole-v1")
    assert known is not None
    scores = summarize(run).scores
    for episodes in {settings.episodes, known["episodes"]}:
        cut = evaluate(run, episodes=episodes, max_episode_steps=2)
        assert cut.score("CartPole-v1").mean == 2.0
    assert evaluations.mean_returns(100, settings) == before
    assert evaluations.best_known(100, "CartPole-v1") == known
    assert summarize(run).scores == scores


@pytest.mark.slow
def test_only_an_evaluation_under_the_runs_own_protocol_ends_it(finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    os.rename(finished, run)
    try:
        assert train(run=run).status == "already_finished"
        for path in (run / "evaluations").glob("*_n4_*"):
            path.unlink()
        again = train(run=run)
        assert again.status == "finished"
        assert again.evaluation is not None
        assert again.evaluation.protocol.episodes == 4
    finally:
        os.rename(run, finished)


def test_evaluations_of_older_versions_are_found_by_what_they_hold(tmp_path: Path) -> None:
    facts = {
        "step": 7,
        "protocol": {"episodes": 3, "epsilon": 0.05, "seed": 1, "num_envs": 1, "suite": "gym", "environment": []},
        "tasks": [
            {"policy": policy, "task": "a", "episodes": 3, "mean": mean, "mean_length_steps": 9.0}
            for policy, mean in (("agent", 2.5), ("random", 1.0))
        ],
    }
    (tmp_path / "step-000000000007_a_n3_seed1.json").write_text(json.dumps(facts))
    evaluations, settings = Evaluations(tmp_path), EvaluationConfig(episodes=3, seed=1)
    assert evaluations.mean_returns(7, settings) == {"a": 2.5}
    assert evaluations.mean_returns(7, replace(settings, epsilon=0.0)) == {}
    (tmp_path / "step-000000000007_a_n4_seed1.json").write_text("{}")
    with pytest.raises(RunFolderError, match="expected an evaluation; delete it"):
        evaluations.mean_returns(7, settings)
