"""What a run decides before it starts, with what reason, and what it stores."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from switchmt_snn.config import ExperimentConfig, from_dict, load_config, to_dict
from switchmt_snn.errors import ConfigError
from switchmt_snn.runs import plan as plans
from switchmt_snn.runs.plan import plan
from switchmt_snn.updates import compiled
from switchmt_snn.updates.engine import ENGINES
from switchmt_snn.updates.native import Native
from tests.conftest import decided, small_config

LONG = compiled.COMPILE_FROM_UPDATES
compiles = pytest.mark.skipif(compiled.compile_problem() is not None, reason="nothing can be compiled here")


def cartpole(**learning: Any) -> ExperimentConfig:
    return from_dict({"device": "cpu", "tasks": {"suite": "gym", "names": ["CartPole-v1"]}, "learning": learning})


def autos(value: Any, key: str = "") -> list[str]:
    if isinstance(value, dict):
        return [found for name, item in value.items() for found in autos(item, f"{key}.{name}".lstrip("."))]
    return [key] if value == "auto" else []


def test_a_planned_config_holds_no_auto_but_the_device() -> None:
    asked = load_config("minatar")
    made = plan(asked)
    assert autos(to_dict(made.config)) in ([], ["device"])
    assert made.config.device == asked.device
    assert made.device == torch.device("cuda" if torch.cuda.is_available() else "cpu")
    assert made.suite.names == asked.tasks.names
    assert made.memory.total_bytes > made.memory.replay_bytes > 0
    again = plan(made.config, made.config)
    assert (again.config, again.notes) == (made.config, ())


def test_a_learning_rate_that_ends_before_the_run_is_named() -> None:
    preset = replace(load_config("cartpole"), device="cpu")
    assert not any("learning rate" in note for note in plan(preset).notes)
    (note,) = [note for note in plan(replace(preset, total_steps=120_000)).notes if "learning rate" in note]
    assert "is 0 after 30,000 of up to 59,904 updates" in note
    assert "learning.learning_rate_decay_updates 59904" in note


def test_a_run_that_cannot_fit_is_refused_by_its_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("switchmt_snn.runs.memory.available_bytes", lambda: 8 * 2**30)
    with pytest.raises(ConfigError, match=r"lower learning\.replay_capacity_steps to at most"):
        plan(cartpole(replay_capacity_steps=10**9))


@pytest.mark.parametrize(
    ("learning", "stored"),
    [
        ({}, "none"),
        ({"replay_capacity_steps": 33_000_000}, "none"),
        ({"replay_capacity_steps": 34_000_000}, "zstd"),
        ({"replay_capacity_steps": 34_000_000, "replay_compression": "none"}, "none"),
        ({"replay_capacity_steps": 34_000_000, "replay_on_device": True}, "none"),
        ({"replay_compression": "zstd"}, "zstd"),
    ],
)
def test_compression_is_decided_by_the_size_of_plain_frames_and_stored(learning: dict[str, Any], stored: str) -> None:
    """Two tasks whose frames have four float32 features: 1 GiB holds 33.6 million steps of both."""
    assert decided(small_config(learning=learning))[0].learning.replay_compression == stored


def test_a_run_keeps_the_precision_engine_and_compression_it_began_with() -> None:
    asked = small_config(total_steps=10_000_000, learning={"precision": "auto"})
    stored = small_config(learning={"engine": "eager", "precision": "float32", "replay_compression": "zstd"})
    learning = decided(asked, stored)[0].learning
    assert (learning.engine, learning.precision, learning.replay_compression) == ("eager", "float32", "zstd")


def test_a_stored_config_without_an_engine_means_eager() -> None:
    before_the_choice = small_config(total_steps=10_000_000)
    assert decided(small_config(total_steps=10_000_000), before_the_choice)[0].learning.engine == "eager"


@pytest.mark.parametrize(("engine", "acting"), [("native", "native"), ("eager", "eager"), ("compiled", "eager")])
def test_actions_come_from_the_engine_if_it_acts(engine: str, acting: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ENGINES[engine], "unavailable", classmethod(lambda *_: None))
    asked = small_config(learning={"engine": engine})
    assert decided(asked)[0].learning.acting == acting
    assert decided(asked, asked)[0].learning.acting == "eager"  # a run from before there was a choice
    begun = small_config(learning={"engine": engine, "acting": acting})
    assert decided(asked, begun)[0].learning.acting == acting
    assert decided(small_config(learning={"engine": engine, "acting": "eager"}))[0].learning.acting == "eager"


def test_native_acting_needs_the_native_engine() -> None:
    with pytest.raises(ConfigError, match=r"learning\.acting is 'native', expected .* engine is 'eager'; use"):
        decided(small_config(learning={"engine": "eager", "acting": "native"}))


@compiles
def test_auto_compiles_long_runs_only_and_says_so() -> None:
    short, no_notes = decided(small_config())
    long, notes = decided(small_config(total_steps=LONG, network={"method": "DQN_D"}))
    assert (short.learning.engine, no_notes) == ("eager", ())
    assert long.learning.engine == "compiled"
    assert len(notes) == 1
    assert "first" in notes[0]
    every: dict[str, Any] = {"update_every_steps": 4, "update_tasks": "all"}  # two tasks: one update per two steps
    assert compiled.planned_updates(small_config(total_steps=1000, learning=every)) == 500
    every["updates_per_round"] = 3
    assert compiled.planned_updates(small_config(total_steps=1000, learning=every)) == 1500


def test_without_a_compiler_auto_says_so_and_compiled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "compile_problem", lambda: "no g++")
    config, notes = decided(small_config(total_steps=LONG, network={"method": "DQN_D"}))
    assert config.learning.engine == "eager"
    assert "compiled engine: torch.compile fails on this machine (no g++)" in notes[0]
    with pytest.raises(ConfigError, match=r"learning\.engine is 'compiled'.*no g\+\+.*eager"):
        decided(small_config(learning={"engine": "compiled"}))


@pytest.mark.parametrize("name", ENGINES)
def test_an_engine_that_is_asked_for_is_taken_or_refused_with_its_reason(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ENGINES[name], "unavailable", classmethod(lambda *_: None))
    config, notes = decided(small_config(learning={"engine": name}))
    assert (config.learning.engine, notes) == (name, ())
    monkeypatch.setattr(ENGINES[name], "unavailable", classmethod(lambda *_: "the sky fell"))
    with pytest.raises(ConfigError, match=f"engine is '{name}', expected .*, but the sky fell; use learning.engine"):
        decided(small_config(learning={"engine": name}))
    with pytest.raises(ConfigError, match=r"with which this run was begun.*--run OTHER"):
        decided(small_config(), small_config(learning={"engine": name}))


@pytest.mark.parametrize("is_worth_it", [True, False])
def test_auto_takes_the_native_engine_where_it_pays_and_works(
    is_worth_it: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Native, "pays", classmethod(lambda *_: is_worth_it))
    monkeypatch.setattr(Native, "unavailable", classmethod(lambda *_: None))
    config, notes = decided(small_config())
    assert config.learning.engine == ("native" if is_worth_it else "eager")
    assert notes == ((Native.note,) if is_worth_it else ())
    monkeypatch.setattr(Native, "unavailable", classmethod(lambda *_: "no luck"))
    config, notes = decided(small_config())
    assert config.learning.engine == "eager"
    assert notes == (("updates do not use the native engine: no luck",) if is_worth_it else ())


@pytest.mark.parametrize(("has_it", "precision"), [(True, "bfloat16"), (False, "float32")])
def test_auto_precision_follows_the_processor(monkeypatch: pytest.MonkeyPatch, has_it: bool, precision: str) -> None:
    monkeypatch.setattr(plans, "has_bfloat16", lambda device: has_it)
    config, notes = decided(small_config(learning={"precision": "auto"}))
    assert config.learning.precision == precision
    assert precision in notes[0]


def test_a_run_of_an_older_version_is_planned_as_it_was(tmp_path: Path) -> None:
    """A stored config with ``auto`` inside and keys missing equals the plan that continues it."""
    old = from_dict({"device": "cpu", "tasks": {"suite": "gym", "names": ["CartPole-v1"]}})
    assert old.learning.replay_compression == "auto"
    made = plan(old, old)
    assert plans.decide(made.config, old, made.suite, made.device)[0] == made.config
    assert (made.config.learning.engine, made.config.learning.replay_compression) == ("eager", "none")


@pytest.mark.slow
@pytest.mark.parametrize("begun_with", [True, False])
def test_a_run_goes_on_clipping_as_it_began(begun_with: bool) -> None:
    """A gym run of a version that clipped by default is continued by the same config, which does not name it."""
    stored = plan(cartpole(clip_rewards=begun_with)).config
    assert plan(cartpole(), stored).config.learning.clip_rewards is begun_with
    assert plan(cartpole()).config.learning.clip_rewards is False
