"""The training commands on result pages train what their runs did."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs.tools.commands import as_it_ran, by_key
from switchmt_snn.cli import main
from switchmt_snn.config.yaml_io import from_dict

RESULTS = Path(__file__).parents[2] / "results"
COMMAND = re.compile(r"`switchmt-snn (train results/\S+/config\.yaml[^`]*)`")


def commands() -> list[str]:
    return [command for page in sorted(RESULTS.glob("*/README.md")) for command in COMMAND.findall(page.read_text())]


@pytest.mark.slow
@pytest.mark.parametrize("command", commands())
def test_a_printed_command_asks_for_every_setting_that_the_run_had(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also for settings that did not exist then and have another default today."""
    monkeypatch.chdir(RESULTS.parent)
    words = shlex.split(command)
    with pytest.raises(SystemExit) as stop:
        main([*words, "--print-config"])
    assert stop.value.code == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    printed.pop("decided", None)
    assert by_key(from_dict(printed)) == by_key(as_it_ran(RESULTS.parent / Path(words[1]).parent))


def test_every_page_of_trained_runs_prints_them() -> None:
    folders = {Path(command.split()[1]).parent for command in commands()}
    stored = {path.parent.relative_to(RESULTS.parent) for path in RESULTS.glob("*/*/config.yaml")}
    printed_elsewhere = {"cartpole", "export"}
    assert folders == {path for path in stored if path.parts[1] not in printed_elsewhere}


@pytest.mark.parametrize("world", json.loads((RESULTS / "environments" / "grid_worlds.json").read_text()))
def test_the_table_of_grid_worlds_is_what_was_measured(world: dict[str, Any]) -> None:
    command = world["command"].partition(" --evaluation.")[0]
    agent, random = (next(row for row in world["tasks"] if row["policy"] == policy) for policy in ("agent", "random"))
    row = f"| `{command}` | {agent['mean']:.2f} | {random['mean']:.2f} | {agent['episodes']} |"
    assert row in (RESULTS.parent / "docs" / "extending.md").read_text("utf-8").splitlines()
    assert world["runs"] == 1
    assert f"--total-steps {world['step']}" in command


@pytest.mark.slow
@pytest.mark.parametrize("world", json.loads((RESULTS / "environments" / "grid_worlds.json").read_text()))
def test_the_command_of_a_grid_world_asks_for_what_was_measured(
    world: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([*shlex.split(world["command"])[1:], "--print-config"])
    printed = yaml.safe_load(capsys.readouterr().out)
    assert (printed["seed"], printed["total_steps"]) == (world["seed"], world["step"])
    assert printed["tasks"]["names"] == [world["tasks"][0]["task"]]
    kept = ("episodes", "epsilon", "seed", "num_envs", "max_episode_steps")
    assert {key: printed["evaluation"][key] for key in kept} == {key: world["protocol"][key] for key in kept}
