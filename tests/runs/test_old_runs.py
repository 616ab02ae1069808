"""Runs that an earlier version made still open, continue, evaluate and export (tests/fixtures/runs/README.md)."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.config import load_config
from switchmt_snn.errors import CheckpointError
from switchmt_snn.export import ExportSettings, export, load_exported, profile

FIXTURES = Path(__file__).parents[1] / "fixtures" / "runs"
CONTINUED_TO = {"gym": 480, "minatar": 360}


@pytest.fixture(params=sorted(CONTINUED_TO))
def old_run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of an old run, in a folder of its name."""
    shutil.copytree(FIXTURES / request.param, tmp_path / request.param)
    return tmp_path / request.param


def columns(path: Path, names: tuple[str, ...]) -> list[tuple[str, ...]]:
    with path.open(newline="") as stream:
        return [tuple(row[name] for name in names) for row in csv.DictReader(stream)]


FREE = ("trunk.conv1.synapses.bias", "trunk.conv1.normalization.running_mean_KC")
"""BatchNorm takes a bias before it away again: its gradient is 0 but for rounding, of which Adam makes steps (they were
up to 8.5e-5 on a processor without AVX-512), and the running mean follows."""


@pytest.mark.slow
def test_an_old_run_continues_as_the_old_version_continued_it(old_run: Path) -> None:
    """Same episodes, and the same weights to rounding (another processor may sum in another order)."""
    steps = CONTINUED_TO[old_run.name]
    before = (old_run / "switches.csv").read_text()
    config = load_config(old_run / "config.yaml")
    result = train(config.__class__(**{**vars(config), "total_steps": steps}), run=old_run)
    assert (result.status, result.step) == ("finished", steps)
    weights = load_file(old_run / "checkpoints" / f"step-{steps:012d}" / "model.safetensors")
    expected = load_file(FIXTURES / f"{old_run.name}.continued.safetensors")
    assert weights.keys() == expected.keys()
    for name, tensor in expected.items():
        atol = 2e-4 if name in FREE else 1e-5
        torch.testing.assert_close(weights[name], tensor, rtol=1e-4, atol=atol, msg=name)
    names = ("step", "task", "episode", "length_steps", "truncated", "updates")
    expected_rows = columns(FIXTURES / f"{old_run.name}.continued.episodes.csv", names)
    assert columns(old_run / "episodes.csv", names) == expected_rows
    after = (old_run / "switches.csv").read_text()
    assert after.startswith(before)
    assert len({line.count(",") for line in after.splitlines()}) == 1  # a table still


@pytest.mark.slow
def test_an_old_run_evaluates_to_its_old_scores(old_run: Path) -> None:
    (stored,) = (old_run / "evaluations").glob("*.json")
    old_scores = {row["task"]: row["mean"] for row in json.loads(stored.read_text())["tasks"]}
    evaluation = evaluate(old_run, save=False)
    assert {row.task: row.mean for row in evaluation.tasks} == pytest.approx(old_scores)


def test_an_unknown_checkpoint_is_refused(old_run: Path) -> None:
    with pytest.raises(CheckpointError, match=r"the checkpoint is 'bset', expected last or best"):
        load_agent(old_run, checkpoint="bset")


@pytest.mark.slow
def test_old_onnx_files_decide_as_the_old_run_does(old_run: Path) -> None:
    agent, exported = load_agent(old_run, device="cpu"), load_exported(old_run, "onnx")
    assert agent.suite.names
    for task in agent.suite.names:
        k = agent.suite.index(task)
        observation = agent.suite.make(k, 1).reset(np.array([0]), np.array([5]))
        stacked = np.repeat(observation, agent.suite.frame_stack, axis=1)
        expected, q_values = agent.q_values(stacked, task=task), exported.q_values(stacked, k)
        if agent.config.network.encoding == "rate":  # each draws random spikes of its own
            assert np.isfinite(q_values).all()
            assert q_values.shape == expected.shape
        else:
            np.testing.assert_allclose(q_values, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_an_old_run_is_exported_and_profiled_again(old_run: Path, tmp_path: Path) -> None:
    result = export(old_run, ExportSettings(parity_decisions=20), "last", tmp_path / "again", lambda text: None)
    assert result.parity["failures"] == []
    facts = profile(old_run, 20, "last", tmp_path / "profile").facts
    assert {task["task"] for task in facts["tasks"]} == set(load_agent(old_run).suite.names)


@pytest.mark.slow
def test_every_config_of_the_stored_results_still_loads() -> None:
    paths = sorted((FIXTURES.parents[2] / "results").rglob("config.yaml"))
    assert len(paths) > 20
    for path in paths:
        load_config(path)
