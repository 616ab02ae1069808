"""The commands on result pages: each trains what its stored run did, also where today's defaults are others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from switchmt_snn.config import ExperimentConfig, load_config, resolve
from switchmt_snn.config.yaml_io import to_dict
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.plan import plan

ROOT = Path(__file__).parents[2]
NO_NUMBER = ("learning.replay_compression", "tasks.image_layout")
"""Settings that change no number of these runs: compression is lossless, and none of them has a user's images."""
UNCHECKED = "These runs were not repeated\nsince: a later version may round otherwise."
"""Of runs whose commands nobody compared with the folders."""


def as_it_ran(run: Path) -> ExperimentConfig:
    """The config of a stored run with every setting that it did not have yet as the run went without it."""
    stored = RunFolder(run).config()
    return plan(stored, stored).config


def by_key(config: ExperimentConfig) -> dict[str, Any]:
    """Settings by their path, as ``learning.engine``, without those that change no number."""
    return {key: value for key, value in _flat(to_dict(config)) if key not in NO_NUMBER}


def _flat(settings: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def repeating(run: Path) -> str:
    """The command that repeats a stored run with today's version."""
    config = run / "config.yaml"
    was, now = by_key(as_it_ran(run)), by_key(resolve(load_config(config)))
    flags = [f"--{key.replace('_', '-')} {value}" for key, value in was.items() if value != now[key]]
    return " ".join([f"switchmt-snn train {config.relative_to(ROOT)}", *flags, f"--run runs/{run.name}"])


def commands(runs: Iterable[Path], checked: str) -> list[str]:
    """The section of a page: a command for each of its runs, and what was compared with the folders."""
    return [
        "## Commands",
        "",
        "A command asks for every setting that the run had; options stand for settings that did not exist yet. It",
        "repeats a folder on its processor and with its versions (`environment.json`). On another processor sums round",
        f"otherwise, and a training goes its own way from there: compare spreads over seeds. {checked}",
        "",
        "| run | command |",
        "|---|---|",
        *(f"| {run.name} | `{repeating(run)}` |" for run in runs),
    ]
