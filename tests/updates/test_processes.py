"""Two processes under torchrun (gloo, CPU), each with half a batch, against one process with all of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch

from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.parts import make_learner
from switchmt_snn.tasks.registry import make_suite
from tests.conftest import decided, small_config
from tests.runs.test_resume import CONFIG, content
from tests.updates.processes_case import config, outcome

pytestmark = pytest.mark.slow  # torchrun

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone", "-m", "--"]


def torchrun(*words: object, check: int = 0) -> str:
    result = subprocess.run([*TORCHRUN, *map(str, words)], capture_output=True, text=True, timeout=120, check=False)
    assert (result.returncode == 0) == (check == 0), result.stdout + result.stderr
    return result.stdout + result.stderr


def test_two_halves_update_as_one_whole(tmp_path: Path) -> None:
    torchrun("tests.updates.processes_case", tmp_path / "two.safetensors")
    two = safetensors.torch.load_file(tmp_path / "two.safetensors")
    one = outcome(make_learner(config(), make_suite(config().tasks), torch.device("cpu")))
    assert one.keys() == two.keys()
    for name, whole in one.items():
        if name.startswith("grad/"):  # in units of the tensor's largest; a bias before BatchNorm has only rounding
            scale = 1.0 if "conv1.synapses.bias" in name else float(whole.abs().max())
            assert scale > 0, name
            torch.testing.assert_close(two[name] / scale, whole / scale, rtol=1e-3, atol=1e-4, msg=name)
        elif name.startswith("first/"):
            torch.testing.assert_close(two[name], whole, rtol=1e-4, atol=1e-5, msg=name)
    # Adam makes a whole step of the sign of a gradient that is only rounding: those of the conv bias are left out.
    moved = [
        n for n in one if n.startswith("network/") and one[n].is_floating_point() and "conv1.synapses.bias" not in n
    ]
    for name in moved:
        close = torch.isclose(two[name], one[name], atol=1e-4)
        assert not close.numel() or close.float().mean() > 0.98, name
    torch.testing.assert_close(two["loss"], one["loss"], rtol=1e-4, atol=0)
    torch.testing.assert_close(two["q"], one["q"], rtol=1e-3, atol=1e-4)


def test_a_divided_run_resumes_exactly(tmp_path: Path) -> None:
    path = tmp_path / "divided.yaml"
    path.write_text(CONFIG.replace("total_steps: 1600", "total_steps: 600"))
    torchrun("switchmt_snn", "train", path, "--run", tmp_path / "whole")
    torchrun("switchmt_snn", "train", path, "--run", tmp_path / "parts", "--total-steps", 400)
    torchrun("switchmt_snn", "train", path, "--run", tmp_path / "parts", "--total-steps", 600)
    whole, parts = content(tmp_path / "whole"), content(tmp_path / "parts")
    assert whole["step"] == 600
    assert parts["episodes.csv"] == whole["episodes.csv"]
    assert parts["metrics"] == whole["metrics"]


def test_a_batch_that_cannot_be_divided_is_refused(tmp_path: Path) -> None:
    for learning, words in (({"batch_size": 9}, "batch_size is 9"), ({"engine": "compiled"}, "'compiled'")):
        with pytest.raises(ConfigError, match=words):
            decided(small_config(learning=learning), processes=2)
    path = tmp_path / "odd.yaml"
    path.write_text(CONFIG.replace("batch_size: 8", "batch_size: 9"))
    assert "expected a multiple of the 2 processes" in torchrun("switchmt_snn", "train", path, check=1)
