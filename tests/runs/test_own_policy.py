"""A switching criterion from outside the package, as docs/extending.md writes it: trains, and continues by its name."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn.config import ExperimentConfig, load_config, to_yaml
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.learning.events import SwitchDecided
from switchmt_snn.learning.switching import EpisodeRecord, Stay, with_policy
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.logs import RunLogs
from switchmt_snn.runs.run import train
from tests.recipes import EXTENDING, code_of

STEPS = 400


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The recipe's three files, in the current folder."""
    module, config, script = code_of("Switching policy")
    (tmp_path / "my_policies.py").write_text(module)
    (tmp_path / "own_policy.yaml").write_text(config)
    (tmp_path / "train_own.py").write_text(script)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def short(steps: int, **switching: object) -> ExperimentConfig:
    """The recipe's config, for so many steps."""
    config = load_config("own_policy.yaml")
    learning = replace(config.learning, update_every_steps=8)
    return replace(config, total_steps=steps, learning=learning, switching=replace(config.switching, **switching))


def in_fresh_process(folder: Path, *command: str) -> None:
    done = subprocess.run(
        [sys.executable, *command], cwd=folder, env=os.environ, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr


def rows(run: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((run / "switches.csv").read_text().splitlines()))


def test_the_recipe_lists_every_field_of_an_episode_record() -> None:
    listed = re.findall(
        r"^\| `(\w+)(?:\(\))?` \|", EXTENDING.read_text().split("`EpisodeRecord`:")[1].split("\n\n")[1], re.M
    )
    assert listed == [field.name for field in fields(EpisodeRecord)]


@pytest.mark.slow
def test_a_policy_from_outside_trains_and_continues_in_a_fresh_process(folder: Path) -> None:
    """Half of the steps here, the rest by ``train --run`` on the command line: the same as in one go."""
    own = import_module("my_policies").ReturnAbove
    train(short(STEPS), "whole", policy=own)
    train(short(STEPS // 2, policy="my_policies:ReturnAbove"), "parts")
    in_fresh_process(folder, "-m", "switchmt_snn", "train", "--run", "parts", "--total-steps", str(STEPS))
    assert RunFolder(Path("whole")).config() == RunFolder(Path("parts")).config()
    assert rows(Path("parts")) == rows(Path("whole"))
    weights = [load_file(f"{run}/checkpoints/step-{STEPS:012d}/model.safetensors") for run in ("parts", "whole")]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    decided = [row for row in rows(Path("whole")) if row["reason"] == "return_above"]
    assert decided
    assert {row["target"] for row in decided} == {"30"}
    assert all(row["mean_return"] for row in decided)
    assert list(decided[0])[-2:] == ["mean_return", "target"]


@pytest.mark.slow
def test_a_class_of_the_running_script_gets_the_name_of_the_script(folder: Path) -> None:
    trains = (folder / "train_own.py").read_text().replace("from my_policies import ReturnAbove\n", "")
    trains = trains.replace('load_config("own_policy.yaml")', 'load_config("short.yaml")')
    (folder / "short.yaml").write_text(to_yaml(short(STEPS // 2)))
    (folder / "script.py").write_text((folder / "my_policies.py").read_text() + trains)
    in_fresh_process(folder, "script.py")
    assert RunFolder(folder / "runs" / "own-policy").config().switching.policy == "script:ReturnAbove"


@pytest.mark.parametrize(
    ("switching", "complaint"),
    [
        ({"policy": "nowhere:ReturnAbove"}, "expected an importable module"),
        ({"policy": "my_policies:Nothing"}, "has no 'Nothing'"),
        ({"policy": "my_policies:EpisodeRecord"}, "is no criterion"),
        ({"options": ("goal=3",)}, "switching.options has 'goal'"),
    ],
)
def test_a_policy_that_cannot_be_made_leaves_no_run(folder: Path, switching: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        train(short(STEPS, **switching), folder / "run")
    assert "\n" not in str(caught.value)
    assert not (folder / "run").exists()


def test_a_local_class_is_refused_because_no_run_could_name_it(folder: Path) -> None:
    class Local(import_module("my_policies").ReturnAbove):  # type: ignore[misc]
        pass

    with pytest.raises(ConfigError, match="expected a class at the top level of a module"):
        train(short(STEPS), folder / "run", policy=Local)


def test_an_option_that_the_policy_in_place_of_the_configs_lacks_is_refused(folder: Path) -> None:
    mine = import_module("my_policies").ReturnAbove
    (folder / "other_policy.py").write_text(
        "from my_policies import ReturnAbove\n\n\nclass Other(ReturnAbove):\n"
        "    def __init__(self, config, goal=1.0):\n        super().__init__(config, goal)\n"
    )
    other = import_module("other_policy").Other
    config = short(STEPS, policy="my_policies:ReturnAbove", options=("target=3",))
    complaint = r"'target' for the config's policy my_policies:ReturnAbove, which .* by other_policy:Other, .* \(goal\)"
    with pytest.raises(ConfigError, match=complaint):
        train(config, folder / "run", policy=other)
    assert not (folder / "run").exists()
    assert with_policy(config.switching, mine) == config.switching


def decided(reason: str, **measured: float) -> SwitchDecided:
    return SwitchDecided(10, 0, 1, 2, 10, Stay(reason, measured))


def test_rows_follow_the_header_of_an_older_run(tmp_path: Path) -> None:
    logs = RunLogs(tmp_path, ("a", "b"), ("first", "second"), None)
    logs(decided("why", first=0.5))
    sizes = logs.sync()
    logs(decided("lost", first=9.0))
    logs.close()
    again = RunLogs(tmp_path, ("a", "b"), ("second",), sizes)
    again(decided("because, so", second=2.0))
    again.close()
    found = rows(tmp_path)
    assert [(row["reason"], row["first"], row["second"]) for row in found] == [
        ("why", "0.5", ""),
        ("because, so", "", "2"),
    ]


def test_a_policy_that_measures_more_than_its_run_has_columns_for_is_refused(tmp_path: Path) -> None:
    logs = RunLogs(tmp_path, ("a",), ("first",), None)
    sizes = logs.sync()
    logs.close()
    with pytest.raises(RunFolderError, match=r"switches.csv has no column 'second'"):
        RunLogs(tmp_path, ("a",), ("first", "second"), sizes)
