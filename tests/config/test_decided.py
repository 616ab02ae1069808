"""A stored config can be varied: what was left open is decided anew, what was set stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from switchmt_snn.config import METHOD_TRAITS, METHODS, ExperimentConfig, clips_rewards, load_config, resolve, to_yaml
from switchmt_snn.config.yaml_io import from_dict
from switchmt_snn.errors import ConfigError

PRESETS = sorted(path.stem for path in (Path(__file__).parents[2] / "configs").glob("*.yaml"))
VARIED = [preset for preset in PRESETS if load_config(preset).network.dendrites == "auto"]
"""Those that fit every method: named dendrites (``classic``) are refused by methods without."""


def with_method(config: ExperimentConfig, method: str) -> ExperimentConfig:
    return resolve(replace(config, network=replace(config.network, method=method)))  # type: ignore[arg-type]


def written(tmp_path: Path, asked: ExperimentConfig) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(resolve(asked), asked))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("preset", VARIED)
def test_a_stored_config_varies_as_the_one_it_was_made_from(preset: str, method: str, tmp_path: Path) -> None:
    """One key changed gives what the original with that key gives, there and back."""
    original = load_config(preset)
    varied = with_method(load_config(written(tmp_path, original)), method)
    assert varied == with_method(original, method)
    assert varied.network.dendrites == ("shared" if METHOD_TRAITS[method].dendrites else "none")
    there = replace(original, network=replace(original.network, method=method))
    assert with_method(load_config(written(tmp_path, there)), original.network.method) == resolve(original)


def test_a_stored_config_reads_as_it_was_decided_where_a_run_is_read(tmp_path: Path) -> None:
    original = from_dict({"network": {"method": "DQN", "timesteps": 6}, "tasks": {"suite": "gym", "names": ["A-v0"]}})
    path = written(tmp_path, original)
    assert load_config(path, reopen=False) == resolve(original)
    assert load_config(path) == original


def test_a_value_that_was_set_or_edited_stays(tmp_path: Path) -> None:
    path = written(tmp_path, from_dict({"network": {"dendrites": "per_neuron"}}))
    with pytest.raises(ConfigError, match=r"network\.dendrites is 'per_neuron', expected none for method DQN"):
        with_method(load_config(path), "DQN")
    path = written(tmp_path, from_dict({"network": {"method": "DQN"}}))
    data = yaml.safe_load(path.read_text())
    data["network"] |= {"timesteps": 8, "method": "SwitchMT"}
    path.write_text(yaml.safe_dump(data))
    varied = resolve(load_config(path))
    assert varied.network.timesteps == 8, "an edit wins over the record"
    assert (varied.network.dendrites, varied.switching.policy) == ("shared", "parameter_change")


@pytest.mark.slow
def test_the_config_of_an_older_run_can_be_varied(tmp_path: Path) -> None:
    """It has no record: values that the rules give as well are taken as left open."""
    for method, other in (("SwitchMT", "DQN"), ("DQN", "SwitchMT")):
        original = from_dict({"network": {"method": method}, "switching": {"window_episodes": 7}})
        path = tmp_path / "config.yaml"
        path.write_text(to_yaml(resolve(original)))
        (tmp_path / "environment.json").write_text("{}")
        assert with_method(load_config(path), other) == with_method(original, other)
        assert resolve(load_config(path)) == load_config(path, reopen=False) == resolve(original)


@pytest.mark.parametrize(("suite", "clips"), [("atari", True), ("minatar", True), ("gym", False)])
def test_the_suite_decides_whether_rewards_are_clipped(suite: str, clips: bool, tmp_path: Path) -> None:
    """Atari's custom does not leak into other suites, and stays open for a variation with another suite."""
    asked = from_dict({"tasks": {"suite": suite, "names": ["a"]}})
    assert asked.learning.clip_rewards is None
    assert resolve(asked).learning.clip_rewards is clips_rewards(asked) is clips
    assert load_config(written(tmp_path, asked)) == asked
    for value in (True, False):
        asked = from_dict({"tasks": {"suite": suite, "names": ["a"]}, "learning": {"clip_rewards": value}})
        assert resolve(asked).learning.clip_rewards is clips_rewards(asked) is value


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_clips_as_it_did_when_its_results_were_made(preset: str) -> None:
    assert resolve(load_config(preset)).learning.clip_rewards is (preset not in ("cartpole", "classic"))


def test_a_damaged_record_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("decided: {network.trunk: mlp}\n")
    with pytest.raises(ConfigError, match=r"decided is .*, expected 'setting:.*; delete it"):
        load_config(path)
