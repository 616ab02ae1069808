"""The training commands on result pages train what their runs did."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

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
