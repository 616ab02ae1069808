"""Tasks and suites from outside the package: docs/extending.md's code trains, resumes, evaluates and exports."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from switchmt_snn.runs.files import file_name

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
ENVS = ("my_envs:Right-v0", "my_envs:Left-v0")


def write_examples(folder: Path) -> None:
    """The blocks of docs/extending.md whose first line names a file."""
    text = (ROOT / "docs" / "extending.md").read_text()
    for name, content in re.findall(r"```(?:python|yaml)\n# (\S+\.(?:py|yaml))\n(.*?)```", text, re.DOTALL):
        (folder / name).write_text(content)


def call(folder: Path, *words: str, code: int = 0, **variables: str) -> subprocess.CompletedProcess[str]:
    """A process of its own in the folder."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | variables
    result = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    return result


def command(folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """A command in an own process; like the installed script, Python itself does not search the current folder."""
    return call(folder, "-m", "switchmt_snn", *words, code=code, PYTHONSAFEPATH="1")


def episodes(run: Path) -> list[tuple[str, ...]]:
    with (run / "episodes.csv").open(newline="") as stream:
        return [tuple(row[key] for key in ("step", "task", "return")) for row in csv.DictReader(stream)]


@pytest.fixture(scope="module")
def environments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run on two environments of one's own, continued by a second process."""
    folder = tmp_path_factory.mktemp("environments")
    write_examples(folder)
    command(folder, "train", "corridor.yaml", "--run", "run", "--total-steps", "300", "--evaluation.episodes", "2")
    command(folder, "train", "--run", "run", "--total-steps", "500")
    return folder


def test_own_environments_resume_as_if_never_interrupted(environments: Path) -> None:
    flags = ("--total-steps", "500", "--evaluation.episodes", "2")
    command(environments, "train", "corridor.yaml", "--run", "whole", *flags)
    assert episodes(environments / "run") == episodes(environments / "whole")
    assert {task for _, task, _ in episodes(environments / "run")} == set(ENVS)


def test_the_modules_of_own_environments_are_hashed(environments: Path) -> None:
    facts = json.loads((environments / "run" / "environment.json").read_text())
    assert list(facts["files_sha256"]) == ["my_envs"]


def test_own_environments_are_evaluated_and_exported_under_names_that_differ(environments: Path) -> None:
    run = environments / "run"
    scores = json.loads(command(environments, "evaluate", "run", "--episodes", "3", "--json").stdout)
    assert {row["task"] for row in scores["tasks"]} == set(ENVS)
    assert scores["protocol"]["environment"] == []
    command(environments, "evaluate", "run", "--episodes", "3", "--task", ENVS[1])
    name = f"step-000000000500_{file_name(ENVS[1])}_n3_seed10000_epsilon0.05_envs3.json"
    assert (run / "evaluations" / name).is_file()
    command(environments, "export", "run", "--onnx", "--nir", "--task", ENVS[0], "--parity-decisions", "40")
    written = {path.name for path in (run / "export").iterdir()}
    own = f"decision_{file_name(ENVS[0])}.onnx"
    assert written == {"decision.onnx", "step.onnx", own, "parity.json", "MODEL_CARD.md"} | {
        f"{file_name(task)}.{suffix}" for task in ENVS for suffix in ("nir", "json")
    }
    for runtime in ("onnx", "nir"):
        played = json.loads(command(environments, "evaluate", "run", "--runtime", runtime, "--json").stdout)
        assert played["equal_actions_share"] == 1.0
    command(environments, "profile", "run", "--decisions", "40")


def test_a_module_that_is_not_there_is_named_in_one_line(environments: Path) -> None:
    (environments / "broken_envs.py").write_text("import no_such_package\n")
    for name, message in (
        ("no_envs:Right-v0", "importing 'no_envs' fails (No module named 'no_envs')"),
        ("broken_envs:Right-v0", "importing 'broken_envs' fails (No module named 'no_such_package')"),
        ("my_envs:Rigth-v0", "unknown Gymnasium id 'my_envs:Rigth-v0'; did you mean 'my_envs:Right-v0'?"),
    ):
        result = command(environments, "train", "corridor.yaml", "--tasks.names", name, code=2)
        assert result.stderr.count("\n") == 1
        assert message in result.stderr


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run on a suite of one's own, begun in Python."""
    folder = tmp_path_factory.mktemp("suite")
    write_examples(folder)
    call(folder, "check_my_suite.py")
    call(folder, "train_my_suite.py")
    return folder


def test_an_own_suite_is_learned(suite: Path) -> None:
    """Opposite answers to the same observations, in one network."""
    scores = json.loads(command(suite, "evaluate", "runs/cue", "--epsilon", "0", "--json").stdout)
    assert scores["protocol"]["environment"] == ["one decision per episode"]
    means = {row["task"]: row["human_normalized"] for row in scores["tasks"] if row["policy"] == "agent"}
    assert means == {"same": 1.0, "opposite": 1.0}


def test_a_run_of_an_own_suite_continues_from_the_command_line(suite: Path) -> None:
    assert "suite: my_suite:CueSuite" in (suite / "runs" / "cue" / "config.yaml").read_text()
    result = json.loads(command(suite, "train", "--run", "runs/cue", "--total-steps", "830", "--json").stdout)
    assert (result["status"], result["step"]) == ("finished", 830)
    command(suite, "export", "runs/cue", "--parity-decisions", "40")
    facts = json.loads((suite / "runs" / "cue" / "environment.json").read_text())
    assert list(facts["files_sha256"]) == ["my_suite"]


def test_an_own_suite_is_named_in_a_config(suite: Path) -> None:
    flags = ("--tasks.suite", "my_suite:CueSuite", "--total-steps", "200")
    command(suite, "train", "cue.yaml", "--run", "named", *flags)
    result = command(suite, "train", "cue.yaml", *flags, "--tasks.names", "same", "other", code=2)
    assert "unknown cue task 'other'" in result.stderr
    result = command(suite, "train", "cue.yaml", "--tasks.suite", "my_suite:Cue", code=2)
    assert "my_suite' defines, but it has no 'Cue'" in result.stderr
    assert result.stderr.count("\n") == 1
