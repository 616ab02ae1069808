"""Every script of examples/ runs, shortened by its own flags."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SHORT = {
    "01_train_cartpole.py": ["--steps", "700", "--run", "runs/cartpole"],
    "02_own_environment.py": ["--steps", "700"],
    "03_own_policy.py": ["--steps", "700"],
    "04_own_neuron.py": ["--steps", "600"],
    "05_export_and_act.py": ["--run", "runs/cartpole", "--decisions", "20"],
    "switchmt_in_one_file.py": ["--steps", "200", "--hidden", "8"],
}
"""Arguments that make a script short. Scripts run in this order and in one folder: 05 reads the run of 01."""


def run_example(name: str, folder: Path) -> str:
    """A script's output, run as a reader runs it."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, ROOT / "examples" / name, *SHORT[name]]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{name}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_every_example_is_run_by_a_test() -> None:
    scripts = {path.name for path in (ROOT / "examples").glob("*.py") if not path.name.startswith("my_")}
    assert scripts == set(SHORT)
    listed = (ROOT / "examples" / "README.md").read_text()
    assert all(f"]({name})" in listed for name in scripts), "examples/README.md must list every script"


@pytest.mark.slow
def test_examples_run_in_order(tmp_path: Path) -> None:
    outputs = {name: run_example(name, tmp_path) for name in SHORT}
    assert "switches:" in outputs["01_train_cartpole.py"]
    assert "Follow-v0: score" in outputs["02_own_environment.py"]
    assert " -> " in outputs["03_own_policy.py"]
    assert "my_neuron:RefractoryIF" in outputs["04_own_neuron.py"].split("export: ")[1], "refused by name"
    assert "the exported file balanced the pole" in outputs["05_export_and_act.py"]
    assert (tmp_path / "runs/cartpole/profile/report.html").is_file()
