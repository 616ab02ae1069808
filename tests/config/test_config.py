"""Configs are read strictly; presets and their documentation are true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from switchmt_snn.config import (
    METHOD_TRAITS,
    METHODS,
    POLICIES,
    ExperimentConfig,
    differences,
    field_documentation,
    from_dict,
    load_config,
    resolve,
    to_yaml,
)
from switchmt_snn.config.other_names import OTHER_NAMES
from switchmt_snn.errors import ConfigError

ROOT = Path(__file__).parents[2]
PRESETS = sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"learning": {"batchsize": 3}}, r"unknown key learning.batchsize; did you mean 'batch_size'\?"),
        ({"sed": 3}, r"unknown key sed; did you mean 'seed'\?"),
        ({"learning": {"batch_size": "many"}}, "learning.batch_size is 'many', expected a whole number"),
        ({"learning": {"batch_size": 3.5}}, "expected a whole number"),
        ({"learning": {"batch_size": True}}, "expected a whole number"),
        ({"learning": {"learning_rate": "fast"}}, "expected a finite number"),
        ({"learning": {"learning_rate": float("nan")}}, "expected a finite number"),
        ({"learning": {"discount": float("inf")}}, "expected a finite number"),
        ({"learning": {"clip_rewards": "yes please"}}, "expected true or false"),
        ({"learning": 3}, "learning is 3, expected a mapping"),
        ({"tasks": {"names": "pong"}}, "tasks.names is 'pong', expected a list"),
        ({"tasks": {"names": []}}, "expected at least one task"),
        ({"tasks": {"names": ["pong", "pong"]}}, "expected every task once"),
        ({"network": {"method": "SwitchMTT"}}, "did you mean 'SwitchMT'"),
        ({"network": {"timesteps": 0}}, "network.timesteps is 0, expected at least 1"),
        ({"network": {"method": "DQN", "encoding": "rate"}}, "expected direct for the ANN method DQN"),
        ({"network": {"method": "DSQN", "dendrites": "shared"}}, "expected none for method DSQN"),
        ({"learning": {"batch_size": 100, "replay_capacity_steps": 50}}, "lower the batch or raise the capacity"),
        ({"learning": {"batch_size": 1}}, "BatchNorm needs a batch"),
        ({"learning": {"learning_starts_steps": 3}}, "expected between batch_size"),
        ({"total_steps": -5}, "total_steps is -5, expected at least 1"),
        ({"switching": {"min_stay_steps": 9, "max_stay_steps": 3}}, "at least min_stay_steps"),
        ({"switching": {"policy": "nothing"}}, "switching.policy is 'nothing', expected one of"),
        ([1, 2], "the file is .1, 2., expected a mapping"),
    ],
)
def test_bad_settings_are_one_clear_line(data: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        from_dict(data)
    assert "\n" not in str(caught.value)


def test_numbers_as_people_write_them() -> None:
    config = from_dict(yaml.safe_load("learning: {learning_rate: 1e-4, batch_size: 64.0}"))
    assert config.learning.learning_rate == 1e-4
    assert config.learning.batch_size == 64


def test_no_such_file_names_the_nearest_preset() -> None:
    with pytest.raises(ConfigError, match="did you mean 'quickstart'"):
        load_config("quickstrt")


def test_broken_yaml_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text("learning: [")
    with pytest.raises(ConfigError, match="is not YAML") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["evaluation.every_steps", "network.hidden_units", "tasks.frame_stack"])
def test_a_refused_0_is_told_how_to_switch_the_setting_off(key: str) -> None:
    section, name = key.split(".")
    with pytest.raises(ConfigError, match=f"{key} is 0, expected at least 1 or null"):
        from_dict({section: {name: 0}})
    resolve(from_dict({section: {name: None}}))


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_load_resolve_and_round_trip(preset: str, tmp_path: Path) -> None:
    config = load_config(preset)
    assert config == load_config(ROOT / "configs" / f"{preset}.yaml")
    assert config.name == preset
    resolved = resolve(config)
    assert resolve(resolved) == resolved
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(resolved))
    assert load_config(path) == load_config(path, reopen=False) == resolved


def test_presets_that_the_project_promises() -> None:
    assert {"quickstart", "paper", "released", "minatar"} <= set(PRESETS)


def test_paper_preset_is_table_2() -> None:
    """The paper's Table 2 and section 4, value by value."""
    config = resolve(load_config("paper"))
    learning = config.learning
    assert learning.replay_capacity_steps == 2**20
    assert (learning.batch_size, learning.learning_rate, learning.discount) == (512, 1e-4, 0.99)
    assert (learning.epsilon_start, learning.epsilon_end, learning.epsilon_decay_steps) == (1.0, 0.1, 1_000_000)
    assert learning.target_update_every_steps == 10_000
    assert (learning.loss, learning.update_every_steps, learning.update_tasks) == ("mse", 1, "current")
    assert config.total_steps == 3 * 4_000_000
    assert config.tasks.names == ("pong", "breakout", "enduro")
    assert (config.switching.policy, config.switching.change_threshold) == ("parameter_change", 0.10)
    assert config.network.neuron == "IF"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("policy", POLICIES)
def test_any_method_with_any_policy(method: str, policy: str) -> None:
    config = from_dict({"network": {"method": method}, "switching": {"policy": policy}})
    assert resolve(config).switching.policy == policy
    assert resolve(from_dict({"network": {"method": method}})).switching.policy == (METHOD_TRAITS[method].switching)


def test_differences_name_the_field() -> None:
    old, new = (from_dict({"learning": {"discount": d}}) for d in (0.9, 0.99))
    assert differences(old, new) == {"learning.discount": (0.9, 0.99)}


@pytest.mark.slow
def test_every_field_is_documented() -> None:
    sections = list(field_documentation())
    assert len(sections) > 5
    for prefix, text, rows in sections:
        assert text, prefix
        assert rows, prefix
        for key, _, _, documentation in rows:
            assert len(documentation) > 10, key


@pytest.mark.slow
def test_generated_pages_are_up_to_date() -> None:
    from docs.tools.pages import PAGES

    for name, page in PAGES.items():
        assert (ROOT / name).read_text() == page(), f"{name} differs; run: python -m docs.generate"


def test_defaults_are_a_valid_config() -> None:
    assert resolve(ExperimentConfig()).network.method == "SwitchMT"


def test_every_name_of_another_library_means_a_setting_that_exists() -> None:
    settings = {key for _, _, rows in field_documentation() for key, *_ in rows}
    assert set(OTHER_NAMES.values()) <= settings
    assert not set(OTHER_NAMES) & settings


@pytest.mark.parametrize(
    ("data", "meant"),
    [
        ({"learning": {"gamma": 0.9}}, "did you mean learning.discount?"),
        ({"learning_rate": 0.1}, "did you mean learning.learning_rate?"),
        ({"network": {"batch_size": 3}}, "did you mean learning.batch_size?"),
        ({"env_id": "CartPole-v1"}, "did you mean tasks.names?"),
    ],
)
def test_a_key_of_another_library_or_section_is_told_ours(data: dict[str, object], meant: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(meant)):
        from_dict(data)
