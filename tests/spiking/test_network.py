"""The network: parameter counts, and the folded forward pass against a plain loop over time."""

from __future__ import annotations

from dataclasses import replace
from typing import cast, get_args, get_type_hints

import pytest
import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, NetworkConfig, resolve
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.encodings import ENCODINGS
from switchmt_snn.spiking.network import (
    ObservationSpec,
    QNetwork,
    State,
    Stream,
    TrunkLayer,
    build_network,
    trainable_parameters,
)
from switchmt_snn.spiking.readout import READOUTS

ATARI = ObservationSpec((4, 84, 84), 4, 1 / 255, True, num_actions=18, num_tasks=3)
SMALL = ObservationSpec((4, 10, 10), 4, 1.0, True, num_actions=6, num_tasks=3)

TABLE_3 = {
    "DQN": 1_693_682,
    "DSQN": 1_693_682,
    "DQN_D": 3_300_339,
    "DSQN_D": 3_300_339,
    "MTSpark_AD": 1_693_691,
    "MTSpark_ADD": 3_300_357,
    "SwitchMT": 3_300_357,
}


def network(observation: ObservationSpec = SMALL, seed: int = 0, **settings: object) -> QNetwork:
    settings.setdefault("trunk", "minatar" if observation is SMALL else "nature")
    config = resolve(ExperimentConfig(network=NetworkConfig(**settings))).network  # type: ignore[arg-type]
    return build_network(config, observation, seed)


@pytest.mark.parametrize(("method", "count"), TABLE_3.items())
def test_parameter_counts_of_the_paper(method: str, count: int) -> None:
    assert trainable_parameters(network(ATARI, method=method)) == count


def test_per_neuron_dendrites_add_9216_weights() -> None:
    shared, own = network(ATARI, method="SwitchMT"), network(ATARI, method="SwitchMT", dendrites="per_neuron")
    assert trainable_parameters(own) - trainable_parameters(shared) == 2 * 512 * 3 * 3 - 18


def plain_forward(net: QNetwork, observation: Tensor, task: int) -> Tensor:
    """The network as one would write it first: every layer at every step, snn.Leaky, head at every step."""
    config = net.config
    encoded = net.encoder(observation.float() * net.observation.scale, torch.Generator().manual_seed(5))
    membranes: dict[str, Tensor | None] = {}
    outputs: dict[str, list[Tensor]] = {name: [] for name in net.streams}

    def neuron(name: str, owner: TrunkLayer | Stream, current: Tensor) -> Tensor:
        if not net.spiking:
            return torch.relu(current)
        leaky = owner.neurons.leaky
        spikes, membranes[name] = leaky(current, membranes.get(name, torch.zeros_like(current)))
        return cast(Tensor, spikes)

    for t in range(config.timesteps):
        x = encoded[t if encoded.shape[0] > 1 else 0]
        for name, module in net.trunk.items():
            layer = cast(TrunkLayer, module)
            y = layer.synapses(x)
            x = neuron(name, layer, y if layer.normalization is None else layer.normalization(y, task))
        x = x.flatten(1)
        for name, module in net.streams.items():
            stream = cast(Stream, module)
            current = stream.synapses(x)
            if stream.dendrites is not None:
                current = current * stream.dendrites(task)
            outputs[name].append(stream.head(neuron(name, stream, current)))
    if config.readout == "mean":
        read = {name: torch.stack(values).mean(0) for name, values in outputs.items()}
        return combine(read)
    traces = {}
    for name, values in outputs.items():
        membrane, trace = torch.zeros_like(values[0]), []
        for value in values:
            membrane = config.readout_beta * membrane + value
            trace.append(membrane)
        traces[name] = torch.stack(trace)
    q = combine(traces)
    return q[-1] if config.readout == "last_membrane" else q.max(0).values


def combine(outputs: dict[str, Tensor]) -> Tensor:
    if "q" in outputs:
        return outputs["q"]
    return outputs["value"] + outputs["advantage"] - outputs["advantage"].mean(-1, keepdim=True)


@pytest.mark.parametrize("method", TABLE_3)
@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
@pytest.mark.parametrize("readout", READOUTS)
def test_folded_network_equals_plain_loop(method: str, encoding: str, readout: str) -> None:
    """In eval mode: weights are multiples of 1/64 and inputs of 1/4, so that folding may not even change rounding."""
    ann = method in ("DQN", "DQN_D")
    if ann and (encoding != "direct" or readout != "mean"):
        pytest.skip("an ANN has no time")
    net = network(method=method, encoding=encoding, readout=readout, readout_beta=0.5, reset="subtract").eval()
    torch.manual_seed(1)
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if "segments" in name:  # sigmoid is never dyadic: compare to rounding there, bitwise without
                continue
            parameter.copy_(torch.round(parameter * 64) / 64 + torch.sign(parameter) / 64)
    observation = torch.randint(0, 5, (7, 4, 10, 10)).float() / 4
    ours = net(observation, 1, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(ours, plain_forward(net, observation, 1), rtol=1e-5, atol=1e-5)


def test_gradients_of_the_folded_network_equal_the_plain_loop() -> None:
    """In training mode under an encoding without repetition both see the same BatchNorm batch only at T = 1."""
    net = network(method="SwitchMT", timesteps=1, threshold=0.25).train()
    observation = torch.rand(16, 4, 10, 10)
    grads = []
    for forward in (lambda: net(observation, 0), lambda: plain_forward(net, observation, 0)):
        net.zero_grad()
        forward().pow(2).sum().backward()
        grads.append([parameter.grad.clone() for parameter in net.parameters()])
    assert len(grads[0]) > 5
    for ours, plain in zip(*grads, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-4, atol=1e-5)


def test_state_carries_a_decision_on() -> None:
    """T steps and T more from the state equal 2T steps (last-step activity)."""
    short = network(method="DSQN", timesteps=3).eval()
    long = build_network(replace(short.config, timesteps=6), SMALL, 0).eval()
    long.load_state_dict(short.state_dict())
    observation = torch.rand(2, 4, 10, 10)
    state: State = {}
    first: dict[str, Tensor] = {}
    second: dict[str, Tensor] = {}
    whole: dict[str, Tensor] = {}
    short(observation, 0, state=state, activity=first)
    short(observation, 0, state=state, activity=second)
    long(observation, 0, activity=whole)
    assert len(first) > 1
    for name in first:
        assert torch.equal(whole[name], torch.cat([first[name], second[name]]))


def test_decisions_leave_no_memory() -> None:
    net = network(method="SwitchMT").eval()
    a, b = torch.rand(1, 4, 10, 10), torch.rand(1, 4, 10, 10)
    before = net(a, 0)
    net(b, 0)
    assert torch.equal(net(a, 0), before)


def test_the_task_changes_the_answer_only_through_dendrites_and_statistics() -> None:
    observation = torch.rand(4, 4, 10, 10)
    plain = network(method="DSQN").eval()
    assert torch.equal(plain(observation, 0), plain(observation, 2))
    gated = network(method="MTSpark_AD", threshold=0.1).eval()
    assert not torch.equal(gated(observation, 0), gated(observation, 2))


def test_building_leaves_the_global_generator_alone() -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    network(seed=9)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("readout", "median", "mean or last_membrane or max_membrane"),
        ("trunk", "resnet", "nature or nature_half or minatar or mlp; .*resolve replaces auto"),
        ("trunk", "auto", "nature or nature_half or minatar or mlp; .*resolve replaces auto"),
        ("dendrites", "auto", "none or shared or per_neuron; .*resolve replaces auto"),
        ("dendritic_gating", "min", "max or absolute_max"),
        ("normalization", "none", "per_task or shared"),
        ("neuron", "Izhikevich", "one of IF, LIF, Synaptic, ALIF, or package.module:Class"),
    ],
)
def test_unknown_values_are_refused_by_name(key: str, value: str, expected: str) -> None:
    """Also where a config was made without its own checks."""
    config = resolve(ExperimentConfig(network=NetworkConfig(trunk="minatar"))).network
    object.__setattr__(config, key, value)
    with pytest.raises(ConfigError, match=f"network.{key} is '{value}', expected {expected}"):
        build_network(config, SMALL, 0)


def test_the_registry_of_readouts_and_the_config_know_the_same_names() -> None:
    assert get_args(get_type_hints(NetworkConfig)["readout"]) == tuple(READOUTS)


def test_convolutions_refuse_vectors() -> None:
    with pytest.raises(ConfigError, match="expected mlp for observations"):
        network(ObservationSpec((4,), 1, 1.0, False, 2, 1), trunk="nature", method="DSQN")


def test_convolutions_refuse_images_that_are_too_small() -> None:
    with pytest.raises(ConfigError, match="no output left"):
        network(SMALL, trunk="nature")
