"""Products of spikes that are kept as bits against multiplications."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from switchmt_snn.native import library as native_library
from switchmt_snn.native.neurons import Spikes
from switchmt_snn.native.panels import Panels
from switchmt_snn.native.products import Synapses, convolved
from switchmt_snn.native.supports import spikes_as_bits
from tests.native.spikes import as_bits, random_spikes

pytestmark = [
    pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler"),
    pytest.mark.skipif(native_library.problem() is None and not spikes_as_bits(torch.float32), reason="no AVX-512"),
]


def close(ours: Tensor, exact: Tensor, low: bool) -> None:
    assert exact.numel() > 0
    scale = max(float(exact.abs().max()), 1.0)  # sums of normal numbers may cancel
    torch.testing.assert_close(ours.double(), exact, rtol=5e-3 if low else 1e-5, atol=scale * (4e-3 if low else 2e-6))


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(
    lanes=st.integers(1, 300),
    channels=st.integers(1, 70),
    places=st.integers(1, 50),
    outputs=st.integers(1, 70),
    low=st.booleans(),
    rate=st.sampled_from([0.0, 0.02, 0.3, 1.0]),
    seed=st.integers(0, 2**31),
)
def test_linear_products_and_their_gradients(lanes, channels, places, outputs, low, rate, seed) -> None:
    """Any sizes: whole and partial panels, words, fours of outputs, and more inputs than tables at once."""
    torch.manual_seed(seed)
    spikes_IPC = random_spikes(lanes, places, channels, rate=rate)
    panels = Panels.of_images(as_bits(spikes_IPC), channels)
    flat = spikes_IPC.movedim(-1, 1).flatten(1).double()
    dtype = torch.bfloat16 if low else torch.float32
    weight, bias = torch.randn(outputs, channels * places).to(dtype), torch.randn(outputs)
    close(panels.times(weight, bias), flat @ weight.double().T + bias, low)
    grad_y = torch.randn(lanes, outputs).to(dtype)
    grad_weight, grad_bias = panels.gradients(grad_y)  # not rounded to bfloat16
    close(grad_weight, grad_y.double().T @ flat, False)
    close(grad_bias, grad_y.double().sum(0), False)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    batch=st.integers(1, 9),
    channels=st.integers(1, 70),
    sides=st.tuples(st.integers(4, 12), st.integers(4, 12)),
    kernel=st.integers(1, 4),
    stride=st.integers(1, 3),
    outputs=st.integers(1, 40),
    low=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_convolutions_and_their_gradients(batch, channels, sides, kernel, stride, outputs, low, seed) -> None:
    torch.manual_seed(seed)
    dtype = torch.bfloat16 if low else torch.float32
    layer = nn.Conv2d(channels, outputs, kernel, stride)
    spikes = random_spikes(2, batch, *sides, channels)
    y, gradients = convolved(Spikes(as_bits(spikes), channels, True), Synapses([layer], dtype).read())
    weights = torch.randn(y.shape).to(dtype)
    grad_x, (grad_weight, grad_bias) = gradients(weights, True)
    exact = nn.Conv2d(channels, outputs, kernel, stride).double()
    exact.load_state_dict(
        {
            name: part.to(dtype if name == "weight" else torch.float32).double()
            for name, part in layer.state_dict().items()
        }
    )
    x = spikes.double().requires_grad_()
    y_exact = exact(x.flatten(0, 1).movedim(-1, 1)).movedim(1, -1).view(y.shape)
    (y_exact * weights.double()).sum().backward()
    close(y, y_exact.detach(), low)
    close(grad_x.view(x.shape), x.grad, low)
    close(grad_weight, exact.weight.grad, False)
    close(grad_bias, exact.bias.grad, False)
    assert gradients(weights, False)[0] is None


@pytest.mark.parametrize("bits", [3200, 3215])
def test_a_large_weight_gradient_is_exact_and_the_same_for_any_number_of_threads(bits: int) -> None:
    """It is written around the caches; rows begin at a cache line, or not."""
    spikes, grad_y = random_spikes(70, 1, bits), torch.randn(70, 330)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            results.append(Panels.of_images(as_bits(spikes), bits).gradients(grad_y)[0])
    finally:
        torch.set_num_threads(threads)
    assert results[0].numel() >= 2**20
    close(results[0], grad_y.double().T @ spikes.flatten(1).double(), False)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_nan_and_infinite_weights_reach_only_the_outputs_of_their_spikes() -> None:
    spikes = torch.tensor([[1.0, 0.0], [0.0, 1.0]])[:, None, :]
    for dtype in (torch.float32, torch.bfloat16):
        weight = torch.tensor([[torch.nan, 1.0], [torch.inf, 2.0]]).to(dtype)
        y = Panels.of_images(as_bits(spikes), 2).times(weight, torch.zeros(2))
        assert y[0].isnan()[0]
        assert y[0, 1] == torch.inf
        assert torch.equal(y[1].float(), torch.tensor([1.0, 2.0]))
