"""The whitelist of the native engine: what is not named is refused by name."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from torch import nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.native import supports
from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from tests.conftest import decided, small_config

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ({"method": "DQN_D"}, "no spikes"),
        ({"learn_beta": True, "neuron": "LIF"}, "learn_beta"),
        ({"learn_threshold": True}, "learn_threshold"),
        ({"surrogate": "sigmoid"}, "surrogate=sigmoid"),
        ({"k_winners": 3}, "k_winners"),
        ({"neuron_engine": "snntorch"}, "neuron_engine"),
    ],
)
def test_an_unsupported_setting_is_refused_by_name(setting: dict[str, Any], named: str) -> None:
    asked = small_config(network=setting, learning={"engine": "native"})
    with pytest.raises(ConfigError, match=f"learning.engine is 'native', .*it has no code for .*{named}.*eager"):
        decided(asked)


def test_every_network_setting_is_named_by_the_whitelist() -> None:
    """A new setting must be added there, with the values that the C++ code supports."""
    assert supports._SETTINGS.keys() == {field.name for field in fields(NetworkConfig)}


def test_a_value_that_the_whitelist_does_not_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of a neuron that was added later, and a setting that was added later."""
    config = small_config().network
    assert supports.unsupported_setting(config) is None
    object.__setattr__(config, "neuron", "my_module:MyNeuron")
    assert supports.unsupported_setting(config) == "network.neuron=my_module:MyNeuron"
    later = small_config(network={"timesteps": 9}).network
    monkeypatch.delitem(supports._SETTINGS, "timesteps")
    assert supports.unsupported_setting(later) == "network.timesteps=9"
    assert supports.unsupported_setting(NetworkConfig(trunk="mlp", dendrites="none")) is None  # its default


class OtherNeurons(nn.Module):
    """As a neuron that was added later."""


def network_of(trunk: str) -> QNetwork:
    config = small_config(network={"trunk": trunk, "dendrites": "per_neuron"}).network
    return build_network(config, ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3), 1)


@pytest.mark.parametrize(
    ("trunk", "path", "module"),
    [
        ("minatar", "trunk.conv1.neurons", OtherNeurons()),
        ("minatar", "trunk.conv1.synapses", nn.Conv2d(4, 16, 3, padding=1)),
        ("minatar", "trunk.conv1.synapses", nn.Conv2d(4, 16, 3, groups=2)),
        ("minatar", "trunk.conv1.synapses", nn.Sequential(nn.MaxPool2d(2), nn.Conv2d(4, 16, 3))),
        ("minatar", "trunk.conv1.normalization", nn.BatchNorm2d(16)),
        ("minatar", "trunk.conv1", nn.Identity()),
        ("mlp", "trunk.linear1.synapses", nn.Sequential(nn.Dropout(), nn.Linear(400, 128))),
        ("mlp", "trunk.linear1.synapses", nn.Linear(400, 128, bias=False)),
        ("mlp", "streams.value.neurons", OtherNeurons()),
        ("mlp", "streams.value.dendrites", nn.Identity()),
        ("mlp", "streams.advantage.head", nn.Sequential(nn.Linear(128, 6))),
    ],
)
def test_an_unsupported_module_is_refused_by_name(trunk: str, path: str, module: nn.Module) -> None:
    network = network_of(trunk)
    assert supports.unsupported_module(network) is None
    parent, _, name = path.rpartition(".")
    setattr(network.get_submodule(parent), name, module)
    with pytest.raises(ConfigError, match=rf"it has no code for {path}: {type(module).__name__}.*eager"):
        NativeNetwork(network, None)


def test_normalization_belongs_to_convolutions_only() -> None:
    network = network_of("minatar")
    network.trunk["conv1"].normalization = None
    assert "conv1" in str(supports.unsupported_module(network))
