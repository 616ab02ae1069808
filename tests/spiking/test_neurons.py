"""Neurons: hand-computed traces, and every form of a model against its step."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import snntorch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.network import SURROGATES_WITHOUT_SLOPE
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.neurons import (
    NEURONS,
    SURROGATES,
    AdaptiveNode,
    LeakyLayer,
    LeakyNode,
    NeuronLayer,
    NeuronState,
    ReLULayer,
    SynapticNode,
    make_neuron_layer,
    make_surrogate,
    make_surrogate_gradient,
    register_neuron,
)
from switchmt_snn.spiking.neurons.base import RESETS, over_time

DETERMINISTIC = tuple(name for name in SURROGATES if name != "SSO")
FORMS = [(neuron, engine) for neuron, model in NEURONS.items() for engine in model.ENGINES]
"""Every registered model in every implementation that it has."""


def layer_of(**settings: object) -> NeuronLayer:
    return make_neuron_layer(NetworkConfig(**settings), spiking=True)  # type: ignore[arg-type]


def trace(current: list[float], **settings: object) -> tuple[list[float], list[float]]:
    """Spikes and last state of one neuron for a current over time."""
    spikes, state = layer_of(**settings)(torch.tensor(current).view(-1, 1, 1))
    return spikes.flatten().tolist(), [float(variable) for variable in state]


@pytest.mark.parametrize("engine", NEURONS["LIF"].ENGINES)
def test_if_and_lif_follow_traces_computed_by_hand(engine: str) -> None:
    # IF, reset to zero: 0.6, 1.2 (fires), 0 + 0.6, 1.2 (fires). The returned membrane is before its reset.
    assert trace([0.6] * 4, neuron_engine=engine) == ([0, 1, 0, 1], [pytest.approx(1.2)])
    # IF, subtract: 0.75, 1.5 (fires), 1.5 + 0.75 - 1 = 1.25 (fires), 1.25 + 0.75 - 1 = 1.0: not above 1.
    assert trace([0.75] * 4, neuron_engine=engine, reset="subtract") == ([0, 1, 1, 0], [1.0])
    # Exactly at the threshold does not fire: 0.5, 1.0, 1.5.
    assert trace([0.5] * 3, neuron_engine=engine) == ([0, 0, 1], [1.5])
    # LIF, beta 0.5: 0.75, 0.375 + 0.75 = 1.125 (fires), 0.75, 1.125 (fires).
    assert trace([0.75] * 4, neuron_engine=engine, neuron="LIF", beta=0.5) == ([0, 1, 0, 1], [1.125])


@pytest.mark.parametrize("engine", NEURONS["Synaptic"].ENGINES)
def test_synaptic_follows_traces_computed_by_hand(engine: str) -> None:
    settings = {"neuron": "Synaptic", "alpha": 0.5, "beta": 0.5, "neuron_engine": engine}
    # Currents are 1, 0.5 * 1 + 1 = 1.5, 0.75 + 1 = 1.75, 0.875, whatever the reset.
    # zero: 1 (not above 1), 0.5 * 1 + 1.5 = 2 (fires), 0.5 * 2 + 1.75 = 2.75 which the reset makes 0, 0 + 0.875.
    assert trace([1.0, 1.0, 1.0, 0.0], **settings, reset="zero") == ([0, 1, 0, 0], [0.875, 0.875])
    # subtract: 1, 2 (fires), 2.75 - 1 = 1.75 (fires), 0.5 * 1.75 + 0.875 - 1 = 0.75.
    assert trace([1.0, 1.0, 1.0, 0.0], **settings, reset="subtract") == ([0, 1, 1, 0], [0.875, 0.75])


def test_alif_follows_traces_computed_by_hand() -> None:
    settings = {"neuron": "ALIF", "beta": 0.5, "adaptation_decay": 0.5, "adaptation_strength": 0.5}
    # zero: 1.25 > 1 (fires); reset: 1.25, adaptation 1, threshold 1.5: not above;
    # 0.625 + 1.25 = 1.875, adaptation 0.5, threshold 1.25 (fires); reset: 1.25, adaptation 0.25 + 1, threshold 1.625.
    assert trace([1.25] * 4, **settings, reset="zero") == ([1, 0, 1, 0], [1.25, 1.25])
    # subtract: 1.5 > 1 (fires); 0.75 + 1.5 - 1 = 1.25, adaptation 1, threshold 1.5: not above;
    # 0.625 + 1.5 = 2.125, adaptation 0.5, threshold 1.25 (fires); then the crossed 1.25 is taken off:
    # 1.0625 + 1.5 - 1.25 = 1.3125, adaptation 0.25 + 1, threshold 1.625.
    assert trace([1.5] * 4, **settings, reset="subtract") == ([1, 0, 1, 0], [1.3125, 1.25])


def test_alif_learns_through_the_rise_of_its_threshold() -> None:
    """The first spike resets to zero, so the first current reaches the second spike through the threshold alone."""
    layer = layer_of(neuron="ALIF", beta=0.5, adaptation_strength=0.5)
    current = torch.full((2, 1, 1), 1.25, requires_grad=True)
    spikes, _ = layer(current)
    spikes[1].sum().backward()
    # U - theta is 1.25 - 1 at the first step and 1.25 - 1.5 at the second; the atan surrogate's slope at x is
    # g(x) = 1 / (1 + (pi x)^2), and dS(2)/dI(1) = g(-0.25) * -strength * g(0.25).
    slope = 1 / (1 + (math.pi * 0.25) ** 2)
    assert current.grad is not None
    assert current.grad.flatten().tolist() == pytest.approx([-0.5 * slope**2, slope])


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    beta=st.floats(0.0, 1.0, width=32), reset=st.sampled_from(RESETS), seed=st.integers(0, 2**31), T=st.integers(1, 9)
)
def test_alif_without_adaptation_is_lif(beta: float, reset: str, seed: int, T: int) -> None:
    torch.manual_seed(seed)
    current = torch.randn(T, 3, 17) * 1.5
    spikes, state = layer_of(neuron="ALIF", adaptation_strength=0.0, beta=beta, reset=reset)(current)
    expected, (membrane,) = layer_of(neuron="LIF", beta=beta, reset=reset)(current)
    assert torch.equal(spikes, expected)
    assert torch.equal(state[0], membrane)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    form=st.sampled_from(FORMS),
    reset=st.sampled_from(RESETS),
    beta=st.floats(0.0, 1.0, width=32),
    alpha=st.floats(0.0, 1.0, width=32),
    threshold=st.floats(0.125, 2.0, width=32),
    surrogate=st.sampled_from(DETERMINISTIC),
    timesteps=st.integers(1, 9),
    seed=st.integers(0, 2**31),
    start=st.booleans(),
)
def test_every_form_equals_the_step(form, reset, beta, alpha, threshold, surrogate, timesteps, seed, start) -> None:
    """Bitwise equal spikes and states; gradients of currents and first state equal to rounding."""
    neuron, engine = form
    layer = layer_of(
        neuron=neuron,
        neuron_engine=engine,
        reset=reset,
        beta=beta,
        alpha=alpha,
        threshold=threshold,
        surrogate=surrogate,
    )
    torch.manual_seed(seed)
    values = torch.randn(timesteps, 3, 17) * 1.5
    first = [torch.randn(3, 17) * start for _ in layer.STATE]
    weights, last_weights = torch.randn(timesteps, 3, 17), [torch.randn(3, 17) for _ in layer.STATE]
    results = []
    for run in (layer.run, lambda current, state: over_time(layer.step, current, state)):
        current = values.clone().requires_grad_()
        state = tuple(variable.clone().requires_grad_() for variable in first)
        spikes, last = run(current, state)
        loss = (spikes * weights).sum() + sum((x * w).sum() for x, w in zip(last, last_weights, strict=True))
        grads = torch.autograd.grad(loss, [current, *state])
        results.append(([spikes.detach(), *(x.detach() for x in last)], grads))
    (ours, our_grads), (plain, plain_grads) = results
    for value, expected in zip(ours, plain, strict=True):
        assert torch.equal(value, expected)
    for grad, expected in zip(our_grads, plain_grads, strict=True):
        torch.testing.assert_close(grad, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    reset=st.sampled_from(RESETS),
    alpha=st.floats(0.0, 1.0, width=32),
    beta=st.floats(0.0, 1.0, width=32),
    threshold=st.floats(0.125, 2.0, width=32),
    seed=st.integers(0, 2**31),
)
def test_synaptic_is_bitwise_snntorchs(reset: str, alpha: float, beta: float, threshold: float, seed: int) -> None:
    theirs = snntorch.Synaptic(alpha, beta, threshold=threshold, reset_mechanism=reset)
    snntorch.SpikingNeuron.instances.remove(theirs)
    torch.manual_seed(seed)
    current = torch.randn(8, 3, 17) * 1.5
    synaptic, membrane, expected = torch.zeros(3, 17), torch.zeros(3, 17), []
    for current_t in current:
        spikes_t, synaptic, membrane = theirs(current_t, synaptic, membrane)
        expected.append(spikes_t)
    spikes, state = layer_of(neuron="Synaptic", reset=reset, alpha=alpha, beta=beta, threshold=threshold)(current)
    assert torch.equal(spikes, torch.stack(expected))
    assert torch.equal(state[0], synaptic)
    assert torch.equal(state[1], membrane)


@pytest.mark.slow
@pytest.mark.parametrize("reset", RESETS)
@pytest.mark.parametrize("neuron", NEURONS)
def test_traced_code_equals_the_step(neuron: str, reset: str) -> None:
    """What torch.compile is given, without a compiler's rounding."""
    layer = layer_of(neuron=neuron, reset=reset)
    torch.manual_seed(2)
    current = torch.randn(5, 3, 17) * 1.5
    traced = torch.compile(layer, backend="eager", fullgraph=True)
    spikes, state = traced(current)
    expected, last = over_time(layer.step, current, layer.initial_state(current[0]))
    assert 0.05 < float(spikes.mean()) < 0.95
    assert torch.equal(spikes, expected)
    for variable, value in zip(state, last, strict=True):
        assert torch.equal(variable, value)


@pytest.mark.parametrize("neuron", NEURONS)
def test_a_step_changes_nothing_but_what_it_returns(neuron: str) -> None:
    layer = layer_of(neuron=neuron)
    current_t, *state = (torch.randn(3, 17) * 2 for _ in range(1 + len(layer.STATE)))
    before = [x.clone() for x in (current_t, *state, *layer.state_dict().values())]
    first, second = (layer.step(current_t, tuple(state)) for _ in range(2))
    after = [current_t, *state, *layer.state_dict().values()]
    assert all(torch.equal(x, y) for x, y in zip(before, after, strict=True))
    assert torch.equal(first[0], second[0])
    assert set(first[0].unique().tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize(
    ("name", "slope"),
    [(name, slope) for name in DETERMINISTIC for slope in (None, 0.5, 40.0) if SURROGATES[name] or slope is None],
)
def test_surrogate_gradients_equal_snntorchs(name: str, slope: float | None) -> None:
    """Far from the threshold and at it, in place."""
    x = torch.cat([torch.linspace(-9, 9, 3001), torch.tensor([0.0, 1e-30, -1e-30])]).requires_grad_()
    weights = torch.randn(len(x))
    torch.manual_seed(3)
    (expected,) = torch.autograd.grad(make_surrogate(name, slope)(x), x, weights)
    torch.manual_seed(3)
    overwritten = x.detach().clone()
    make_surrogate_gradient(name, slope)(overwritten, weights)
    torch.testing.assert_close(overwritten, expected, rtol=2e-5, atol=1e-9)


@pytest.mark.parametrize(("neuron", "engine"), FORMS)
def test_state_is_explicit(neuron: str, engine: str) -> None:
    """Two halves of a run equal the whole; no call leaves anything in the layer or in snnTorch's global list."""
    before = len(snntorch.SpikingNeuron.instances)
    layer = layer_of(neuron=neuron, neuron_engine=engine)
    assert len(snntorch.SpikingNeuron.instances) == before
    current = torch.rand(6, 2, 5)
    whole, last = layer(current)
    first, state = layer(current[:3])
    second, ended = layer(current[3:], state)
    assert len(last) == len(layer.STATE)
    assert torch.equal(whole, torch.cat([first, second]))
    assert all(torch.equal(x, y) for x, y in zip(last, ended, strict=True))
    assert torch.equal(layer(current)[0], whole), "a second call must not see the first one's state"
    kept = {name: value for name, value in layer.named_buffers() if name.rsplit(".")[-1] in ("mem", "syn")}
    assert all(value.numel() == 0 for value in kept.values())


@pytest.mark.parametrize("neuron", NEURONS)
def test_learnable_parameters_get_gradients(neuron: str) -> None:
    layer = layer_of(neuron=neuron, learn_beta=True, learn_threshold=True)
    layer(torch.rand(5, 2, 8))[0].sum().backward()
    assert {name.split(".")[-1] for name, _ in layer.named_parameters()} == {"beta", "threshold"}
    assert all(parameter.grad is not None and parameter.grad != 0 for parameter in layer.parameters())


@pytest.mark.parametrize("neuron", NEURONS)
def test_the_stochastic_surrogate_trains_every_neuron(neuron: str) -> None:
    layer = layer_of(neuron=neuron, surrogate="SSO")
    assert not getattr(layer, "fused", False), "one backward over T would draw other random numbers than snnTorch"
    current = torch.rand(4, 2, 3, requires_grad=True)
    layer(current)[0].sum().backward()
    assert current.grad is not None
    assert torch.isfinite(current.grad).all()


def test_relu_has_no_state() -> None:
    out, state = ReLULayer(NetworkConfig(method="DQN"))(torch.tensor([[[-1.0, 2.0]]]))
    assert out.tolist() == [[[0.0, 2.0]]]
    assert state == ()


@pytest.mark.parametrize("neuron", NEURONS)
def test_the_sigmoid_surrogate_has_no_nan_far_below_the_threshold(neuron: str) -> None:
    current = torch.full((1, 1, 1), -50.0, requires_grad=True)
    layer_of(neuron=neuron, surrogate="sigmoid")(current)[0].sum().backward()
    assert current.grad is not None
    assert current.grad.item() == 0.0


class Refractory(LeakyLayer):
    """LIF with a step of its own: it ignores the input of the step after a spike."""

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        fired = (state[0] > self.leaky.threshold).to(current_t.dtype)
        return super().step(current_t * (1.0 - fired), state)


def test_an_inherited_fast_form_never_replaces_a_step_of_its_own() -> None:
    layer = Refractory(NetworkConfig(neuron="LIF", beta=0.5))
    spikes, (membrane,) = layer(torch.tensor([2.0, 2.0, 2.0]).view(-1, 1, 1))
    assert spikes.flatten().tolist() == [1, 0, 1]  # 2 (fires); reset and no input: 0; 2 (fires)
    assert float(membrane) == 2.0
    assert layer.node(1).kind.endswith(":Refractory"), "nor may an exporter take it for LIF"
    with pytest.raises(ConfigError, match="neuron_engine is 'snntorch', expected fused"):
        Refractory(NetworkConfig(neuron_engine="snntorch"))


def test_nodes_hold_a_layers_parameters() -> None:
    node = layer_of(neuron="LIF", beta=0.25, threshold=0.75).node(3)
    assert isinstance(node, LeakyNode)
    assert node.facts() == {"neuron": "LIF", "beta": 0.25, "threshold": 0.75, "reset": "zero"}
    assert layer_of(neuron="IF", beta=0.25).node(1).kind == "IF"
    node = layer_of(neuron="Synaptic", alpha=0.25, beta=0.75, reset="subtract").node(2)
    assert isinstance(node, SynapticNode)
    assert node.facts() == {"neuron": "Synaptic", "alpha": 0.25, "beta": 0.75, "threshold": 1.0, "reset": "subtract"}
    node = layer_of(neuron="ALIF", adaptation_decay=0.5, adaptation_strength=0.25).node(2)
    assert isinstance(node, AdaptiveNode)
    assert np.array_equal(node.adaptation_decay_O, [0.5, 0.5])
    assert np.array_equal(node.adaptation_strength_O, [0.25, 0.25])


def test_the_registry_and_the_config_know_the_same_names() -> None:
    hints = get_type_hints(NetworkConfig)
    literal, _ = get_args(hints["neuron"])
    assert get_args(literal) == tuple(NEURONS)
    assert get_args(hints["surrogate"]) == tuple(SURROGATES)
    assert {name for name, argument in SURROGATES.items() if argument is None} == set(SURROGATES_WITHOUT_SLOPE)


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ConfigError, match="neuron 'LIF' is LeakyLayer, expected a name that is free"):
        register_neuron("LIF")(ReLULayer)
    with pytest.raises(ConfigError, match=r"neuron 'GLIF' is not a value of network\.neuron, expected one of IF"):
        register_neuron("GLIF")(LeakyLayer)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"neuron": "Izhikevich"}, "network.neuron is 'Izhikevich', expected one of IF, LIF, Synaptic, ALIF, or pack"),
        (
            {"neuron": "ALIF", "neuron_engine": "snntorch"},
            "'snntorch', expected fused; network.neuron is ALIF",
        ),
        ({"neuron_engine": "eager"}, "network.neuron_engine is 'eager', expected fused or snntorch"),
        ({"reset": "none"}, "network.reset is 'none', expected zero or subtract"),
        (
            {"surrogate": "SSO", "surrogate_slope": 2.0},
            "surrogate_slope is 2.0, expected null with network.surrogate=SSO",
        ),
        ({"surrogate": "atam"}, "network.surrogate is 'atam', expected atan or .*; did you mean 'atan'?"),
    ],
)
def test_unknown_values_are_refused_by_name(settings: dict[str, str], message: str) -> None:
    """Also where a config was made without its own checks."""
    config = NetworkConfig()
    for key, value in settings.items():
        object.__setattr__(config, key, value)
    with pytest.raises(ConfigError, match=message):
        make_neuron_layer(config, spiking=True)


@pytest.mark.parametrize("key", ["alpha", "beta", "adaptation_decay"])
def test_decays_outside_zero_and_one_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=f"network.{key} is 1.5, expected a decay in"):
        replace(NetworkConfig(), **{key: 1.5})
    with pytest.raises(ConfigError, match=r"adaptation_strength is -0\.1, expected at least 0"):
        NetworkConfig(adaptation_strength=-0.1)
