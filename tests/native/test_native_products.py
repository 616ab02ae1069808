"""Products of spikes that are kept as bits against multiplications."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from switchmt_snn.config import resolve
from switchmt_snn.native import library as native_library
from switchmt_snn.native import network as native_network
from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.native.neurons import Spikes
from switchmt_snn.native.products import Panels, Synapses, convolved
from switchmt_snn.native.supports import spikes_as_bits
from switchmt_snn.spiking.network import ObservationSpec, build_network
from tests.conftest import small_config

pytestmark = [
    pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler"),
    pytest.mark.skipif(native_library.problem() is None and not spikes_as_bits(torch.float32), reason="no AVX-512"),
]


def random_spikes(*shape: int, rate: float = 0.3) -> Tensor:
    return (torch.rand(*shape) < rate).float()


def as_bits(spikes: Tensor) -> Tensor:
    """int32 words of 32 channels each, the last dimension being channels."""
    missing = -spikes.shape[-1] % 32
    words = (F.pad(spikes, (0, missing)).unflatten(-1, (-1, 32)).long() << torch.arange(32)).sum(-1)
    return torch.where(words >= 2**31, words - 2**32, words).to(torch.int32)


def close(ours: Tensor, exact: Tensor, low: bool) -> None:
    scale = max(float(exact.abs().max()), 1.0)  # sums of normal numbers may cancel
    torch.testing.assert_close(ours.double(), exact, rtol=5e-3 if low else 1e-5, atol=scale * (4e-3 if low else 2e-6))


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
def test_connections_and_their_weights_gradient(lanes, channels, places, outputs, low, rate, seed) -> None:
    """Any sizes: whole and broken panels, words, fours of outputs, and more inputs than tables at once."""
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
def test_convolutions_and_all_their_gradients(batch, channels, sides, kernel, stride, outputs, low, seed) -> None:
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
def test_a_large_gradient_goes_around_the_caches(bits: int) -> None:
    """Rows that begin where a line of the caches does, or not."""
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


@pytest.mark.parametrize(("lanes", "outputs"), [(700, 52), (2500, 3)])
def test_any_number_of_threads_gives_the_same_bits(lanes: int, outputs: int) -> None:
    """Whether outputs or, where those are few, lanes are divided among them."""
    spikes, weight, grad_y = random_spikes(lanes, 3, 40), torch.randn(outputs, 120), torch.randn(lanes, outputs)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            panels = Panels.of_images(as_bits(spikes), 40)
            results.append((panels.times(weight, torch.ones(outputs)), *panels.gradients(grad_y)))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_what_is_not_a_number_stays_so_in_what_it_reaches() -> None:
    spikes = torch.tensor([[1.0, 0.0], [0.0, 1.0]])[:, None, :]
    for dtype in (torch.float32, torch.bfloat16):
        weight = torch.tensor([[torch.nan, 1.0], [torch.inf, 2.0]]).to(dtype)
        y = Panels.of_images(as_bits(spikes), 2).times(weight, torch.zeros(2))
        assert y[0].isnan()[0]
        assert y[0, 1] == torch.inf
        assert torch.equal(y[1].float(), torch.tensor([1.0, 2.0]))


def test_what_cplusplus_would_read_wrongly_is_refused() -> None:
    panels = Panels.of_images(as_bits(random_spikes(6, 1, 40)), 40)
    for weight, bias in (
        (torch.zeros(8, 39), torch.zeros(8)),
        (torch.zeros(8, 40), torch.zeros(7)),
        (torch.zeros(8, 40), torch.zeros(8).double()),
        (torch.zeros(40, 8).T, torch.zeros(8)),
        (torch.zeros(8, 40), torch.zeros(16)[::2]),
        (torch.zeros(8, 40).double(), torch.zeros(8)),
    ):
        with pytest.raises(ValueError, match="expected"):
            panels.times(weight, bias)
    for words in (torch.zeros(2, 3, 1), torch.zeros(2, 3, 2, dtype=torch.int32)[..., :1]):
        with pytest.raises(ValueError, match="expected contiguous int32"):
            Panels.of_images(words, 3)
    for grad_y in (torch.zeros(5, 8), torch.zeros(8, 6).T, torch.zeros(6, 8, dtype=torch.float64)):
        with pytest.raises(ValueError, match="expected"):
            panels.gradients(grad_y)


@pytest.mark.parametrize("trunk", ["nature", "minatar", "mlp"])
@pytest.mark.parametrize("encoding", ["direct", "rate"])
def test_a_processor_without_the_instructions_computes_the_same(
    trunk: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Q-values and gradients of spikes as bits are those of spikes as numbers, to rounding."""
    side = {"nature": 84, "minatar": 10, "mlp": 6}[trunk]
    spec = ObservationSpec((4, side, side), 1, 1.0, True, 6, 3)
    settings_ = {"trunk": trunk, "encoding": encoding, "threshold": 0.1}
    settings_ |= {"hidden_units": 50} if trunk == "mlp" else {}
    config = resolve(small_config(network=settings_))
    x = (torch.rand(5, 4, side, side) < 0.4).to(torch.uint8)
    results = []
    for has in (True, False):
        monkeypatch.setattr(native_network, "spikes_as_bits", lambda dtype, has=has: has)
        network = build_network(config.network, spec, 1)
        for part in network.parameters():
            part.data = (part.data * 256).round() / 256  # exact sums: no spike hangs on their order
        native = NativeNetwork(network, None)
        inputs = native.inputs(x, torch.Generator().manual_seed(0))
        (q,) = native.decide(inputs, native.view(0), training=True)
        q.square().sum().backward()
        grads = {name: part.grad for name, part in network.named_parameters() if part.grad is not None}
        results.append((q.detach(), grads))
    (ours, our_grads), (theirs, their_grads) = results
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)
    assert our_grads.keys() == their_grads.keys()
    for name, grad in our_grads.items():
        assert grad.any(), name  # heads' weights have some only if hidden neurons fire
        # A bias before normalisation has none except rounding.
        scale = 1.0 if "conv" in name and "synapses.bias" in name else float(their_grads[name].abs().max())
        torch.testing.assert_close(grad, their_grads[name], rtol=1e-3, atol=1e-4 * scale + 1e-7, msg=name)
