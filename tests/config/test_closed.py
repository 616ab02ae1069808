"""A config accepts the values of its annotations and no others, however it is made: in Python, from YAML, by flags."""

from __future__ import annotations

import contextlib
import io
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

from switchmt_snn.cli import main
from switchmt_snn.config import ExperimentConfig, LearningConfig, NetworkConfig, SwitchingConfig, from_dict, resolve
from switchmt_snn.config.checks import accepts_plugins, choices, field_types
from switchmt_snn.config.network import SURROGATES_WITHOUT_SLOPE
from switchmt_snn.errors import ConfigError

SECTIONS: dict[str, Any] = {
    "": ExperimentConfig,
    **{name: kind for name, kind in field_types(ExperimentConfig).items() if is_dataclass(kind)},
}
FIELDS = [(section, name, kind) for section, config in SECTIONS.items() for name, kind in field_types(config).items()]
CHOICES = [(section, name, choices(kind)) for section, name, kind in FIELDS if choices(kind)]
NEEDED: dict[tuple[str, str], dict[str, dict[str, Any]]] = {
    ("encoding", "frames"): {"tasks": {"frame_stack": 4}, "network": {"timesteps": 4}},
    ("encoding", "events"): {"tasks": {"frame_stack": 4}, "network": {"timesteps": 4}},
}
"""Settings that a value needs."""
IDS = [f"{section}.{name}".lstrip(".") for section, name, _ in CHOICES]


def in_python(section: str, name: str, value: object) -> ExperimentConfig:
    config = ExperimentConfig()
    if not section:
        return replace(config, **{name: value})
    return replace(config, **{section: replace(getattr(config, section), **{name: value})})


def in_yaml(section: str, name: str, value: object) -> ExperimentConfig:
    return from_dict({section: {name: value}} if section else {name: value})


def by_flag(section: str, name: str, value: str) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    error = io.StringIO()
    flag = "--" + f"{section}.{name}".lstrip(".").replace("_", "-")
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit) as end:
        main(["train", "--print-config", flag, value])
    return int(end.value.code or 0), error.getvalue()


def test_the_walk_meets_every_choice() -> None:
    found = {f"{section}.{name}" for section, name, _ in CHOICES}
    assert {".device", "network.neuron", "network.encoding", "learning.loss", "switching.policy"} <= found


@pytest.mark.slow
@pytest.mark.parametrize(("section", "name", "names"), CHOICES, ids=IDS)
def test_an_unknown_choice_is_refused_from_python_yaml_and_flag(section: str, name: str, names: tuple[str]) -> None:
    unknown = names[-1] + "X"
    for make in (in_python, in_yaml):
        for value in (unknown, "", None, True, 3, [names[0]]):
            with pytest.raises(ConfigError, match="expected one of") as caught:
                make(section, name, value)
            assert caught.value.exit_code == 2
            assert name in str(caught.value)
            assert "\n" not in str(caught.value)
    code, error = by_flag(section, name, unknown)
    assert (code, error.count("\n")) == (2, 1)
    assert repr(unknown) in error
    assert name.replace("_", "-") in error.replace("_", "-")


@pytest.mark.parametrize(("section", "name", "names"), CHOICES, ids=IDS)
def test_every_choice_makes_a_config(section: str, name: str, names: tuple[str]) -> None:
    assert names
    for value in names:
        data: dict[str, Any] = {key: dict(rest) for key, rest in NEEDED.get((name, value), {}).items()}
        (data.setdefault(section, {}) if section else data)[name] = value
        config = resolve(from_dict(data))
        assert getattr(getattr(config, section) if section else config, name) in names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loss": "mae"}, "learning.loss is 'mae', expected one of mse, huber; did you mean 'mse'?"),
        ({"engine": "nativ"}, "did you mean 'native'?"),
        ({"precision": "bf16"}, "learning.precision is 'bf16', expected one of auto, float32, bfloat16"),
        ({"batch_size": True}, "learning.batch_size is True, expected a whole number"),
        ({"learning_rate": True}, "learning.learning_rate is True, expected a finite number"),
        ({"double_q": 1}, "learning.double_q is 1, expected true or false"),
        ({"discount": float("nan")}, "learning.discount is nan, expected a finite number"),
    ],
)
def test_a_learning_config_made_in_python_is_checked(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        replace(LearningConfig(), **change)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"neuron": "ALIFX"}, "network.neuron is 'ALIFX', expected one of IF, LIF"),
        ({"encoding": "raet"}, "did you mean 'rate'?"),
        ({"surrogate_slope": "steep"}, "network.surrogate_slope is 'steep', expected a finite number"),
        ({"surrogate_slope": -5.0}, "network.surrogate_slope is -5.0, expected above 0, or null"),
        ({"surrogate_slope": 0.0}, "network.surrogate_slope is 0.0, expected above 0, or null"),
        *(
            (
                {"surrogate": name, "surrogate_slope": 2.0},
                f"network.surrogate_slope is 2.0, expected null with network.surrogate={name}, which has no slope",
            )
            for name in SURROGATES_WITHOUT_SLOPE
        ),
    ],
)
def test_a_network_config_made_in_python_is_checked(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        NetworkConfig(**change)
    assert message in str(caught.value)


def test_a_plateau_cannot_be_below_every_slope() -> None:
    with pytest.raises(ConfigError, match=r"switching.plateau_t is -1.0, expected at least 0"):
        SwitchingConfig(plateau_t=-1.0)
    assert SwitchingConfig(plateau_t=0.0).plateau_t == 0.0


def test_python_and_yaml_store_the_same_types() -> None:
    values: dict[str, Any] = {"batch_size": 64.0, "gradient_clip_at": 2, "learning_rate": "1e-4"}
    made = replace(LearningConfig(), **values)
    assert made == from_dict({"learning": values}).learning
    assert [type(getattr(made, name)) for name in values] == [int, float, float]
    listed: Any = ["pong"]
    assert replace(ExperimentConfig().tasks, names=listed).names == ("pong",)
    with pytest.raises(ConfigError, match=r"tasks.names is 'pong', expected a list"):
        replace(ExperimentConfig().tasks, names="pong")
    with pytest.raises(ConfigError, match=r"network is 'small', expected a NetworkConfig"):
        replace(ExperimentConfig(), network="small")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["my_module:MyClass", "package.module:Name"])
def test_names_of_classes_are_accepted_where_a_field_says_so(name: str) -> None:
    for section, field, kind in FIELDS:
        if not choices(kind):
            continue
        if accepts_plugins(kind):
            assert getattr(getattr(in_python(section, field, name), section), field) == name
        else:
            with pytest.raises(ConfigError):
                in_python(section, field, name)


@pytest.mark.slow
def test_every_field_is_checked() -> None:
    """A value that no field can hold is refused by all of them."""
    refused = set()
    for config in SECTIONS.values():
        for field in fields(config):
            with pytest.raises(ConfigError, match=field.name):
                config(**{field.name: object()})
            refused.add(field.name)
    assert {"seed", "neuron", "batch_size", "policy", "episodes", "names", "tensorboard"} <= refused
