"""Neurons in C++ against PyTorch's operations."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.native import library as native_library
from switchmt_snn.native.neurons import Currents, Neurons, batch_moments, scaled_images
from switchmt_snn.spiking.neurons import LeakyLayer
from tests.native.networks import neurons_of

pytestmark = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")
FORMS = {
    "neuron": st.sampled_from(["IF", "LIF"]),
    "reset": st.sampled_from(["zero", "subtract"]),
    "surrogate": st.sampled_from(["atan", "fast_sigmoid"]),
    "surrogate_slope": st.sampled_from([None, 0.5, 3.0]),
    "beta": st.floats(0.0, 1.0, width=32),
    "threshold": st.sampled_from([0.125, 0.5, 1.0]),
}


def plain_gated(config: NetworkConfig, y_SRC: Tensor, gain_C: Tensor) -> Tensor:
    current_SRC = y_SRC.float() * gain_C
    spikes, _ = LeakyLayer(config)(current_SRC.expand(config.timesteps, *y_SRC.shape[1:]))
    return spikes


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    form=st.fixed_dictionaries(FORMS),
    timesteps=st.integers(1, 7),
    shared=st.booleans(),
    rows=st.integers(1, 80),
    channels=st.integers(1, 70),
    low=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_spikes_are_bitwise_those_of_the_eager_neurons(form, timesteps, shared, rows, channels, low, seed) -> None:
    """And gradients equal to rounding, for shared and single currents, whole and broken blocks of channels."""
    config = NetworkConfig(trunk="mlp", dendrites="none", timesteps=timesteps, **form)
    torch.manual_seed(seed)
    y = (torch.randn(1 if shared else timesteps, rows, channels) * 1.5).to(torch.bfloat16 if low else torch.float32)
    weights, gain = torch.randn(timesteps, rows, channels), torch.linspace(0.3, 1.2, channels)
    y_SRC, gain_C = y.clone().requires_grad_(), gain.clone().requires_grad_()
    theirs = plain_gated(config, y_SRC, gain_C)
    (theirs * weights).sum().backward()
    neurons = Neurons(config)
    ours, currents_4C = neurons.fire(y, Currents(gain), "float32")
    grad_y, (grad_gain, _) = neurons.fire_backward(y, currents_4C, weights)
    assert torch.equal(ours, theirs)
    for our_grad, their_grad in ((grad_y, y_SRC.grad), (grad_gain, gain_C.grad)):
        scale = float(their_grad.abs().max()) + 1e-6
        torch.testing.assert_close(
            our_grad, their_grad, rtol=1e-2 if low else 1e-4, atol=scale * (5e-3 if low else 1e-5)
        )


@pytest.mark.parametrize("channels", [5, 16, 32, 47, 80])
def test_every_form_has_the_same_spikes(channels: int) -> None:
    """Dense, float32, bits (no bit beyond the channels), mean."""
    neurons, currents = neurons_of(3), Currents(torch.ones(channels))
    y = (torch.randn(3, 21, channels) * 2).bfloat16()
    floats, _ = neurons.fire(y, currents, "float32")
    assert 0.1 < floats.mean() < 0.9
    assert torch.equal(neurons.fire(y, currents, "dense")[0], floats.bfloat16())
    unpacked = (neurons.fire(y, currents, "bits")[0][..., None] >> torch.arange(32)) & 1
    assert torch.equal(unpacked.flatten(2), F.pad(floats, (0, -channels % 32)).int())
    mean, currents_4C = neurons.fire(y, currents, "mean")
    assert torch.equal(mean, floats.mean(0, keepdim=True))
    shared = torch.randn(1, 21, channels).expand(3, -1, -1)
    ours, theirs = (neurons.fire_backward(y, currents_4C, grad) for grad in (shared, shared.contiguous()))
    assert all(torch.equal(our, their) for our, their in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("steps", [1, 4])
def test_normalized_spikes_equal_batch_norm_and_neurons(dtype: torch.dtype, steps: int) -> None:
    """In training: spikes, and the gradient through the batch's own mean and variance."""
    config = NetworkConfig(trunk="mlp", dendrites="none", timesteps=4)
    torch.manual_seed(3)
    y, g = (torch.randn(steps, 400, 24) * 3 + 5).to(dtype), torch.randn(4, 400, 24)
    weight, bias = torch.rand(24) + 0.5, torch.randn(24) / 3
    y_SRC, weight_C, bias_C = (x.clone().requires_grad_() for x in (y, weight, bias))
    flat = y_SRC.flatten(0, 1).to(torch.float64)
    current = F.batch_norm(flat, None, None, weight_C.double(), bias_C.double(), True, 0.1, 1e-5)
    current = current.float().view(steps, 400, 24).expand(4, 400, 24)
    spikes, _ = LeakyLayer(config)(current)
    (spikes * g.to(dtype).float()).sum().backward()
    neurons = Neurons(config)
    ours, currents_4C = neurons.fire(y, Currents(weight, bias, *batch_moments(y), 1e-5), "dense")
    grad_y, (grad_weight, grad_bias) = neurons.fire_backward(y, currents_4C, g.to(dtype))
    assert ours.mean() > 0.1
    assert torch.equal(ours.float(), spikes)
    low = dtype == torch.bfloat16
    for our_grad, part in ((grad_y, y_SRC), (grad_weight, weight_C), (grad_bias, bias_C)):
        assert part.grad is not None
        scale = float(part.grad.abs().max())
        torch.testing.assert_close(
            our_grad, part.grad, rtol=1e-2 if low else 1e-4, atol=scale * (1e-2 if low else 1e-5)
        )


@pytest.mark.parametrize(("mean", "first"), [(300.0, 300.0), (-1e4, -1e4), (0.0, 1000.0)])
def test_moments_keep_their_digits(mean: float, first: float) -> None:
    """Far from zero, and with one value far from all others."""
    y = torch.randn(2, 5000, 40) + mean
    y[0, 0] = first
    mean_C, var_C = batch_moments(y)
    torch.testing.assert_close(mean_C.double(), y.double().mean((0, 1)), rtol=1e-6, atol=1e-7 * abs(first))
    torch.testing.assert_close(var_C.double(), y.double().var((0, 1), correction=0), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("steps", "rows"), [(1, 2), (1, 63), (4, 150)])
def test_running_moments_move_as_in_batch_norm(steps: int, rows: int) -> None:
    y, (mean_C, var_C) = torch.randn(steps, rows, 37) * 3 + 2, (torch.randn(37), torch.rand(37))
    theirs = mean_C.clone(), var_C.clone()
    F.batch_norm(y.flatten(0, 1), *theirs, training=True, momentum=0.3)
    batch_moments(y, (mean_C, var_C), 0.3)
    torch.testing.assert_close((mean_C, var_C), theirs, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"expected contiguous float32 \[37\]"):
        batch_moments(y, (mean_C.double(), var_C), 0.3)
    with pytest.raises(ValueError, match="one row, expected two"):
        batch_moments(y[:1, :1], (mean_C, var_C), 0.3)


@pytest.mark.parametrize("shape", [(3, 4, 84, 84), (2, 4, 7, 9), (2, 1, 5, 5), (1, 6, 13, 11)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_scaled_images_are_bitwise_those_of_torch(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    x = torch.randint(0, 256, shape, dtype=torch.uint8)
    ours = scaled_images(x, 1 / 255, dtype)
    assert torch.equal(ours, (x.float() * (1 / 255)).to(dtype))
    assert ours.is_contiguous(memory_format=torch.channels_last)
