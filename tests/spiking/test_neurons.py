"""Neurons: hand-computed traces, and the fused engine against snnTorch itself."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args, get_type_hints

import pytest
import snntorch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.neurons import ReLULayer, SpikingLayer, make_surrogate, make_surrogate_gradient

SURROGATES = tuple(name for name in get_args(get_type_hints(NetworkConfig)["surrogate"]) if name != "SSO")


def run(config: NetworkConfig, current: list[float]) -> tuple[list[float], float]:
    """Spikes and last membrane of one neuron for a current over time."""
    spikes, membrane = SpikingLayer(config)(torch.tensor(current).view(-1, 1, 1))
    return spikes.flatten().tolist(), float(membrane)


@pytest.mark.parametrize("engine", ["fused", "snntorch"])
def test_traces_computed_by_hand(engine: str) -> None:
    base = NetworkConfig(neuron_engine=engine)
    # IF, reset to zero: 0.6, 1.2 (fires), 0 + 0.6, 1.2 (fires). The returned membrane is before its reset.
    assert run(base, [0.6] * 4) == ([0, 1, 0, 1], pytest.approx(1.2))
    # IF, subtract: 0.75, 1.5 (fires), 1.5 + 0.75 - 1 = 1.25 (fires), 1.25 + 0.75 - 1 = 1.0: not above 1.
    assert run(replace(base, reset="subtract"), [0.75] * 4) == ([0, 1, 1, 0], 1.0)
    # Exactly at the threshold does not fire: 0.5, 1.0, 1.5.
    assert run(base, [0.5] * 3) == ([0, 0, 1], 1.5)
    # LIF, beta 0.5: 0.75, 0.375 + 0.75 = 1.125 (fires), 0.75, 1.125 (fires).
    assert run(replace(base, neuron="LIF", beta=0.5), [0.75] * 4) == ([0, 1, 0, 1], 1.125)


@settings(max_examples=60, deadline=None)
@given(
    reset=st.sampled_from(["zero", "subtract"]),
    neuron=st.sampled_from(["IF", "LIF"]),
    beta=st.floats(0.0, 1.0, width=32),
    threshold=st.floats(0.125, 2.0, width=32),
    surrogate=st.sampled_from(SURROGATES),
    timesteps=st.integers(1, 9),
    seed=st.integers(0, 2**31),
    start=st.booleans(),
)
def test_fused_equals_snntorch(reset, neuron, beta, threshold, surrogate, timesteps, seed, start) -> None:
    """Bitwise equal spikes and membranes; gradients of current and first membrane equal to rounding."""
    config = NetworkConfig(reset=reset, neuron=neuron, beta=beta, threshold=threshold, surrogate=surrogate)
    torch.manual_seed(seed)
    values = torch.randn(timesteps, 3, 17) * 1.5
    first = torch.randn(3, 17) if start else torch.zeros(3, 17)
    weights, last_weights = torch.randn(timesteps, 3, 17), torch.randn(3, 17)
    results = []
    for engine in ("fused", "snntorch"):
        current, membrane = values.clone().requires_grad_(), first.clone().requires_grad_()
        spikes, last = SpikingLayer(replace(config, neuron_engine=engine))(current, membrane)
        ((spikes * weights).sum() + (last * last_weights).sum()).backward()
        results.append((spikes.detach(), last.detach(), current.grad, membrane.grad))
    fused, plain = results
    assert torch.equal(fused[0], plain[0])
    assert torch.equal(fused[1], plain[1])
    torch.testing.assert_close(fused[2], plain[2], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fused[3], plain[3], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("slope", [None, 0.5, 40.0])
@pytest.mark.parametrize("name", SURROGATES)
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


@pytest.mark.parametrize("engine", ["fused", "snntorch"])
def test_state_is_explicit(engine: str) -> None:
    """Two halves of a run equal the whole, nothing is kept between calls or in snnTorch's global list."""
    before = len(snntorch.SpikingNeuron.instances)
    layer = SpikingLayer(NetworkConfig(neuron_engine=engine))
    assert len(snntorch.SpikingNeuron.instances) == before
    current = torch.rand(6, 2, 5)
    whole, last = layer(current)
    first, membrane = layer(current[:3])
    second, ended = layer(current[3:], membrane)
    assert torch.equal(whole, torch.cat([first, second]))
    assert torch.equal(last, ended)
    assert torch.equal(layer(current)[0], whole), "a second call must not see the first one's membrane"
    assert layer.leaky.mem.numel() == 0


def test_learnable_parameters_get_gradients() -> None:
    layer = SpikingLayer(NetworkConfig(neuron="LIF", learn_beta=True, learn_threshold=True))
    layer(torch.rand(5, 2, 8))[0].sum().backward()
    assert {name for name, _ in layer.named_parameters()} == {"leaky.beta", "leaky.threshold"}
    assert all(parameter.grad is not None and parameter.grad != 0 for parameter in layer.parameters())


def test_stochastic_surrogate_runs_through_snntorch() -> None:
    layer = SpikingLayer(NetworkConfig(surrogate="SSO"))
    assert not layer.fused
    current = torch.rand(4, 2, 3, requires_grad=True)
    layer(current)[0].sum().backward()
    assert torch.isfinite(current.grad).all()


def test_relu_has_no_state() -> None:
    out, state = ReLULayer()(torch.tensor([[[-1.0, 2.0]]]))
    assert out.tolist() == [[[0.0, 2.0]]]
    assert state is None


def test_sigmoid_surrogate_has_no_nan_far_below_the_threshold() -> None:
    current = torch.full((1, 1, 1), -50.0, requires_grad=True)
    SpikingLayer(NetworkConfig(surrogate="sigmoid"))(current)[0].sum().backward()
    assert current.grad.item() == 0.0
