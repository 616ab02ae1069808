"""The package without the folder ``native/``: everything else works, and the engine says why it does not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

ALONE = """
import sys
# An editable install of the package would find the folder where it is installed from.
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
"""
"""Begins every program of this test."""

PROGRAM = """
from switchmt_snn.cli import main
main()
"""

IMPORTS = """
import importlib, pkgutil, sys
import switchmt_snn
from switchmt_snn.errors import MissingExtraError

names = [module.name for module in pkgutil.walk_packages(switchmt_snn.__path__, "switchmt_snn.")]
assert len(names) > 80, names
assert not any(name.startswith("switchmt_snn.native") for name in names), names
for name in names:
    if name != "switchmt_snn.__main__":
        importlib.import_module(name)
print(len(names), "modules")
"""

TRAINING = """
import sys
from dataclasses import replace
import numpy as np
import torch
from switchmt_snn.config import load_config, resolve
from switchmt_snn.learning.learner import Learner
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import ObservationSpec, build_network
from switchmt_snn.updates.engine import ENGINES

torch.set_num_threads(1)
preset = load_config("quickstart")
losses = {}
for name in ("eager", "auto"):
    learning = replace(preset.learning, engine=name)
    config = resolve(replace(preset, network=replace(preset.network, trunk="minatar"), learning=learning))
    network = build_network(config.network, ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3), 1)
    learner = Learner(network, config.learning, np.ones((3, 6), np.bool_), torch.device("cpu"), 0)
    rng = np.random.default_rng(0)
    for step in range(3):
        x = (rng.random((2, 8, 4, 10, 10)) < 0.4).astype(np.uint8)
        ones = np.ones(8, np.float32)
        learner.update(Batch(x[0], rng.integers(0, 6, 8), ones, x[1], np.zeros(8, np.bool_), ones), step)
    losses[name] = learner.take_means()["loss"]
assert losses["eager"] == losses["auto"] > 0, losses
assert ENGINES["native"].status() == "the package switchmt_snn.native is not installed"
print(sorted(losses))
"""

CONFIG = """
name: tiny
total_steps: 60
device: cpu
tasks: {suite: gym, names: [CartPole-v1]}
network: {trunk: mlp, hidden_units: 8, timesteps: 2}
learning: {batch_size: 8, learning_starts_steps: 16, replay_capacity_steps: 200}
evaluation: {episodes: 1}
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package without ``native/``, with the folders that it links to."""
    root = tmp_path_factory.mktemp("copy")
    ignored = shutil.ignore_patterns("__pycache__")
    for folder in ("export", "configs"):
        shutil.copytree(ROOT / folder, root / folder, ignore=ignored)
    shutil.copytree(ROOT / "switchmt_snn", root / "switchmt_snn", ignore=ignored, symlinks=True)
    shutil.rmtree(root / "switchmt_snn" / "native")
    return root


def run(package: Path, program: str, *arguments: object, code: int = 0) -> str:
    environment = {**os.environ, "PYTHONPATH": str(package), "PYTHONOPTIMIZE": ""}
    command = [sys.executable, "-c", ALONE + program, *map(str, arguments)]
    result = subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == code, result.stdout + result.stderr
    return result.stdout + result.stderr


@pytest.mark.slow
def test_every_other_module_can_be_imported(package: Path) -> None:
    assert "modules" in run(package, IMPORTS)


@pytest.mark.slow
def test_eager_and_auto_updates_train(package: Path) -> None:
    assert "['auto', 'eager']" in run(package, TRAINING)


@pytest.mark.slow
def test_a_run_trains_and_exports_and_the_native_engine_is_refused_in_one_line(package: Path, tmp_path: Path) -> None:
    config = tmp_path / "tiny.yaml"
    config.write_text(CONFIG)
    run(package, PROGRAM, "train", config, "--run", tmp_path / "run")
    assert "decision.onnx" in run(package, PROGRAM, "export", tmp_path / "run")
    asked = ("--learning.engine", "native", "--run", tmp_path / "other")
    refused = run(package, PROGRAM, "train", config, *asked, code=2).strip()
    assert "\n" not in refused
    assert "learning.engine is 'native'" in refused
    assert "but the package switchmt_snn.native is not installed; use learning.engine=eager" in refused
