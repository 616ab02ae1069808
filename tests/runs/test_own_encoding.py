"""An encoding from outside the package, as docs/extending.md writes it: trains, continues, evaluates, exports."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn.config import load_config
from switchmt_snn.errors import ExportError
from switchmt_snn.export import ExportSettings, export
from switchmt_snn.runs.run import train
from switchmt_snn.runs.trained import evaluate
from tests.recipes import code_of

FILES = ("my_encodings.py", "own_encoding.yaml", "my_onnx_rule.py", "export_own.py")
STEPS = 160


def in_fresh_process(folder: Path, *command: str) -> str:
    done = subprocess.run(
        [sys.executable, *command], cwd=folder, env=os.environ, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_an_encoding_from_outside_trains_continues_and_exports_with_its_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the steps here, the rest in a fresh process: as in one go. ONNX refuses it until it has a rule."""
    for name, text in zip(FILES, code_of("Encoding"), strict=True):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    config = replace(load_config("own_encoding.yaml"), total_steps=STEPS)
    train(config, "whole")
    train(replace(config, total_steps=STEPS // 2), "runs/own-encoding")
    again = ("-m", "switchmt_snn", "train", "--run", "runs/own-encoding", "--total-steps", str(STEPS))
    in_fresh_process(tmp_path, *again)
    weights = [
        load_file(f"{run}/checkpoints/step-{STEPS:012d}/model.safetensors") for run in ("whole", "runs/own-encoding")
    ]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert evaluate("whole", episodes=1, save=False).step == STEPS
    with pytest.raises(ExportError, match=r"ONNX has no rule for .* my_encodings:Thermometer"):
        export("whole", ExportSettings(onnx=True))
    assert export("whole", ExportSettings(nir=True, parity_decisions=20)).files
    assert "decision.onnx" in in_fresh_process(tmp_path, "export_own.py")
