"""Code from outside the package that changes between two parts of a run is noticed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from switchmt_snn import load_agent, train
from switchmt_snn.config import ExperimentConfig, from_dict
from switchmt_snn.errors import CheckpointError
from switchmt_snn.runs.changes import note_changes
from switchmt_snn.runs.folder import RunFolder
from tests.recipes import code_of

CONFIG = {
    "name": "changing",
    "total_steps": 60,
    "threads": 1,
    "device": "cpu",
    "tasks": {"suite": "minatar", "names": ["breakout", "asterix"]},
    "network": {
        "hidden_units": 16,
        "timesteps": 2,
        "neuron": "my_neurons:PartialReset",
        "encoding": "my_encodings:Thermometer",
    },
    "learning": {"batch_size": 8, "learning_starts_steps": 50, "replay_capacity_steps": 600},
    "switching": {"policy": "my_policies:ReturnAbove", "max_stay_steps": 100},
    "evaluation": {"episodes": 1, "num_envs": 1},
}
MODULES = {"my_neurons": "Neuron", "my_encodings": "Encoding", "my_policies": "Switching policy"}


class Notes:
    """Keeps what a user is told, and the threads that trained."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.threads: set[int] = set()

    def start(self, *facts: object) -> None:
        """Nothing to do."""

    def __call__(self, event: object) -> None:
        """Note the threads of the moment."""
        self.threads.add(torch.get_num_threads())

    def note(self, text: str) -> None:
        """Keep it."""
        self.texts.append(text)

    def stop(self) -> None:
        """Nothing to do."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The modules of docs/extending.md, importable, and a run with all of them."""
    for name, section in MODULES.items():
        (tmp_path / f"{name}.py").write_text(code_of(section)[0])
    monkeypatch.syspath_prepend(tmp_path)
    train(from_dict(CONFIG), run=tmp_path / "run")
    yield tmp_path
    forget()


def forget() -> None:
    for name in MODULES:
        sys.modules.pop(name, None)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    os.utime(path, (0, path.stat().st_mtime + 10))  # no compiled file of the old text is taken
    forget()


def continued(folder: Path, steps: int) -> list[str]:
    notes = Notes()
    config: ExperimentConfig = replace(from_dict(CONFIG), total_steps=steps)
    train(config, run=folder / "run", observers=[notes])
    return [text for text in notes.texts if text.startswith("warning: the code")]


@pytest.mark.slow
def test_the_modules_of_a_runs_plugins_are_hashed(folder: Path) -> None:
    facts = json.loads((folder / "run" / "environment.json").read_text())
    assert set(facts["files_sha256"]) == set(MODULES)


@pytest.mark.slow
def test_a_module_that_changed_before_a_resume_is_named_once(folder: Path) -> None:
    assert continued(folder, 70) == []
    assert not (folder / "run" / "code_changes.jsonl").exists()
    edit(folder / "my_neurons.py", "membrane + current_t", "0.5 * membrane + current_t")
    edit(folder / "my_policies.py", "mean >= self.target", "mean > self.target")
    (warning,) = continued(folder, 80)
    assert warning.startswith("warning: the code of my_neurons, my_policies changed since the run last went on")
    (row,) = map(json.loads, (folder / "run" / "code_changes.jsonl").read_text().splitlines())
    assert (row["step"], set(row["files_sha256"])) == (70, {"my_neurons", "my_policies"})
    assert continued(folder, 90) == [], "told once"


@pytest.mark.slow
def test_a_parameter_that_the_checkpoint_does_not_have_is_one_line(folder: Path) -> None:
    line = "        self.amount = torch.nn.Parameter(torch.tensor(0.75))"
    edit(folder / "my_neurons.py", line, f"{line.replace('amount', 'gain')}\n{line}")
    for again in (lambda: continued(folder, 80), lambda: load_agent(folder / "run", device="cpu")):
        with pytest.raises(CheckpointError, match=r"does not fit the network .*Missing key\(s\) .*gain") as error:
            again()
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_state_that_the_checkpoint_does_not_have_is_one_line(folder: Path) -> None:
    edit(folder / "my_policies.py", 'SAVED = ("returns",)', 'SAVED = ("returns", "best")')
    edit(
        folder / "my_policies.py",
        "        self.window = window\n",
        "        self.window = window\n        self.best = 0\n",
    )
    with pytest.raises(CheckpointError, match="has no best of ReturnAbove, expected what it saves"):
        continued(folder, 80)


def test_a_file_that_an_older_run_did_not_hash_is_recorded_without_a_warning(folder: Path) -> None:
    run = RunFolder(folder / "run")
    assert note_changes(run.path, {"files_sha256": {"my_new": "0" * 64}}, 60) == []
    (warning,) = note_changes(run.path, {"files_sha256": {"my_new": "1" * 64}}, 65)
    assert "the code of my_new changed" in warning
    assert note_changes(run.path, {"files_sha256": {"my_new": "1" * 64}}, 70) == []


def test_conditions_that_changed_before_a_resume_are_named_once(folder: Path) -> None:
    """A resume is bitwise only under the same versions, processor, device and threads."""
    path = folder / "run"
    begun = json.loads((path / "environment.json").read_text())
    assert note_changes(path, begun, 60) == []
    now = {**begun, "torch_threads": 7, "processor": "another", "versions": {**begun["versions"], "torch": "0.1"}}
    (warning,) = note_changes(path, now, 60)
    for words in ("torch_threads (1 -> 7)", f"torch ({begun['versions']['torch']} -> 0.1)", "-> another)"):
        assert words in warning
    assert "not bitwise as it would have" in warning
    assert note_changes(path, now, 70) == [], "told once"
    rows = [json.loads(line) for line in (path / "code_changes.jsonl").read_text().splitlines()]
    assert rows[0]["conditions"] == {"processor": "another", "torch_threads": 7, "versions.torch": "0.1"}


@pytest.mark.slow
def test_a_continued_run_has_the_threads_that_it_began_with(tmp_path: Path) -> None:
    data = {"tasks": {"suite": "gym", "names": ["CartPole-v1"]}, "network": {"hidden_units": 8}, "device": "cpu"}
    learning = {"batch_size": 8, "learning_starts_steps": 30, "replay_capacity_steps": 100}
    config = from_dict({**data, "learning": learning, "total_steps": 60, "evaluation": {"episodes": 1}})
    torch.set_num_threads(2)
    train(config, run=tmp_path / "run")
    torch.set_num_threads(1)
    notes = Notes()
    train(replace(config, total_steps=90), run=tmp_path / "run", observers=[notes])
    assert notes.threads == {2}
    assert torch.get_num_threads() == 1, "the caller's are left as they were"
    assert not [text for text in notes.texts if text.startswith("warning")]
