"""Random play is played once for all that decides it, and read after that."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn import evaluate, train
from switchmt_snn.acting import evaluation
from switchmt_snn.acting.evaluation import EvaluationProtocol, play_episodes
from switchmt_snn.config import from_dict
from switchmt_snn.runs import random_play
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.random_play import RandomPlay
from switchmt_snn.tasks.registry import make_suite

CONFIG: dict[str, Any] = {
    "total_steps": 60,
    "threads": 1,
    "device": "cpu",
    "tasks": {"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"]},
    "network": {"hidden_units": 8, "timesteps": 2},
    "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 200},
    "evaluation": {"episodes": 3, "num_envs": 2, "max_episode_steps": 60},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("random_play") / "run"
    train(from_dict(CONFIG), run)
    return run


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Policy and task of every group of episodes that is played."""
    groups: list[tuple[str, int]] = []

    def play(policy: str, q_function: Any, suite: Any, task: int, *rest: Any) -> Any:
        groups.append((policy, task))
        return play_episodes(policy, q_function, suite, task, *rest)

    monkeypatch.setattr(evaluation, "play_episodes", play)
    return groups


def randomly(played: list[tuple[str, int]]) -> set[int]:
    tasks = {task for policy, task in played if policy == "random"}
    assert any(policy == "agent" for policy, _ in played), "the agent always plays"
    played.clear()
    return tasks


@pytest.mark.slow
def test_a_later_evaluation_has_the_same_scores_without_playing(run: Path, played: list[tuple[str, int]]) -> None:
    read = evaluate(run)
    assert randomly(played) == set(), "training's final evaluation kept them"
    shutil.rmtree(run / "random_play")
    assert evaluate(run, save=False) == read
    assert randomly(played) == {0, 1}
    assert not (run / "random_play").exists(), "save=False writes nothing"
    assert evaluate(run, task="Acrobot-v1").score("Acrobot-v1", "random") == read.score("Acrobot-v1", "random")
    assert randomly(played) == {1}
    assert evaluate(run) == read
    assert randomly(played) == {0}
    assert evaluate(run, epsilon=0.3).score("CartPole-v1", "random") == read.score("CartPole-v1", "random")
    assert randomly(played) == set(), "random play has no epsilon"


@pytest.mark.slow
@pytest.mark.parametrize("changed", [{"episodes": 2}, {"seed": 3}, {"num_envs": 1}, {"max_episode_steps": 50}])
def test_another_protocol_is_played(run: Path, played: list[tuple[str, int]], changed: dict[str, int]) -> None:
    evaluate(run, **changed)
    assert randomly(played) == {0, 1}
    evaluate(run, **changed)
    assert randomly(played) == set()


@pytest.mark.slow
def test_a_damaged_file_is_played_again(run: Path, played: list[tuple[str, int]]) -> None:
    (path,) = (run / "random_play").glob("CartPole-v1_*.json")
    whole = path.read_text()
    missing = json.loads(whole)
    missing["episodes"].pop()
    other = json.loads(whole)
    other["decided_by"]["python"] = "2.7"
    for text in ("", "{}", "[]", json.dumps(missing), json.dumps(other)):
        path.write_text(text)
        evaluate(run)
        assert randomly(played) == {0}, text
        assert path.read_text() == whole


def test_whatever_decides_the_episodes_is_in_the_name(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = RunFolder(run).config()
    suite, protocol = make_suite(config.tasks), EvaluationProtocol.of(config.evaluation, config.tasks)

    def known(**changes: Any) -> bool:
        mine = {"config": config, "suite": suite, "protocol": protocol, **changes}
        return RandomPlay(run, **mine).read("CartPole-v1") is not None

    assert known()
    assert known(
        config=replace(config, tasks=replace(config.tasks, num_envs=5)), protocol=replace(protocol, epsilon=1.0)
    )
    assert not known(config=replace(config, tasks=replace(config.tasks, names=("CartPole-v1",))))
    assert not known(config=replace(config, tasks=replace(config.tasks, wrappers=("FlattenObservation",))))
    assert not known(protocol=replace(protocol, environment=("sticky actions 0.25",)))
    assert not known(suite=replace(suite, versioned=False)), "code of one's own"
    with monkeypatch.context() as patch:
        patch.setattr(random_play, "_version", lambda package: "9.9")
        assert not known()
    with monkeypatch.context() as patch:
        patch.setattr(random_play, "processor", lambda: "another")
        assert not known()
    assert known()
