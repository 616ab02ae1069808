"""``Discrete(n, start=k)``: every runtime and film plays the actions that were learned, by a loop of the test's own."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import pytest

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.cli import main
from switchmt_snn.export import ExportSettings, evaluate_exported, export
from tests.conftest import small_config

TASK = "tests.tasks.odd_envs:OffsetShown-v0"
LENGTH = 30


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("offset") / "run"
    settings = {"seed": 4, "total_steps": 20, "evaluation": {"episodes": 1, "epsilon": 0.0}}
    train(small_config(tasks={"suite": "gym", "names": [TASK]}, **settings), folder)
    export(folder, ExportSettings(onnx=True, nir=True, parity_decisions=20), "last", None, lambda text: None)
    return folder


def played(run: Path) -> tuple[list[int], list[float]]:
    """The environment's own actions and rewards of an episode, chosen by the ONNX file as docs/deploy.md says."""
    session = onnxruntime.InferenceSession(run / "export" / "decision.onnx")
    first = json.loads(session.get_modelmeta().custom_metadata_map["first_actions"])[TASK]
    env: Any = gymnasium.make(TASK)
    observation, _ = env.reset(seed=0)
    actions, rewards, ended = [], [], False
    names = [one.name for one in session.get_inputs()]
    while not ended:
        values = dict(zip(names, (observation[None], np.zeros(1, np.int64)), strict=False))
        actions.append(int(np.asarray(session.run(None, values)[0])[0].argmax()) + first)
        observation, reward, ended, _, _ = env.step(actions[-1])
        rewards.append(float(reward))
    return actions, rewards


@pytest.mark.slow
def test_every_runtime_and_film_plays_the_environments_own_actions(run: Path, tmp_path: Path) -> None:
    actions, rewards = played(run)
    assert len(actions) == LENGTH
    assert len(set(actions)) > 1
    total = sum(rewards)
    assert total != 0
    for runtime in ("torch", "onnx", "nir"):
        evaluation = evaluate(run) if runtime == "torch" else evaluate_exported(runtime, run)[0]
        (agent,) = [row for row in evaluation.tasks if row.policy == "agent"]
        assert agent.mean == pytest.approx(total)
        out = tmp_path / runtime
        with pytest.raises(SystemExit) as ended:
            main(["play", str(run), "--episodes", "1", "--runtime", runtime, "--out", str(out)])
        assert ended.value.code == 0
        with (out / "film.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert sum(float(row["reward"]) for row in rows) == pytest.approx(total)
        assert [row["action_name"] for row in rows] == [f"action_{action}" for action in actions]
        assert [int(row["action"]) - 1 for row in rows] == actions, "the output's index"
    env: Any = load_agent(run).environment(TASK)
    env.reset(seed=0)
    assert sum(float(env.step(action)[1]) for action in actions) == pytest.approx(total)
