"""A network's decision in C++: what it reads, what it keeps, and what it refuses."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from torch import Tensor

from switchmt_snn.config import resolve
from switchmt_snn.native import library as native_library
from switchmt_snn.native import network as native_network
from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.native.supports import spikes_as_bits
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from switchmt_snn.spiking.readout import READOUTS
from tests.conftest import small_config

pytestmark = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")
HAS_BITS = native_library.problem() is None and spikes_as_bits(torch.float32)


def decision(readout: str) -> tuple[QNetwork, NativeNetwork, Tensor]:
    """A network, natively; and its inputs."""
    settings_ = {"trunk": "minatar", "readout": readout, "threshold": 0.2}
    network = build_network(
        small_config(network=settings_).network, ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3), 1
    )
    native = NativeNetwork(network, None)
    return network, native, native.inputs(torch.rand(5, 4, 10, 10), torch.Generator())


def test_parameters_are_read_again_after_the_target_is_copied() -> None:
    """Its weights are kept between copies, and only between them."""
    spec = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
    config = small_config(network={"trunk": "minatar"}).network
    network, target = build_network(config, spec, 1), build_network(config, spec, 2).requires_grad_(False)
    native = NativeNetwork(target, torch.bfloat16)
    before = native.for_task(1)
    assert native.for_task(1) is before
    gain_N = before.gain_N.clone()
    target.load_state_dict(network.state_dict())
    learning = NativeNetwork(network, torch.bfloat16)
    after, fresh = native.for_task(1), learning.for_task(1)
    assert not torch.equal(after.gain_N, gain_N)
    assert torch.equal(after.gain_N, fresh.gain_N)
    assert not torch.equal(after.gain_N, native.for_task(0).gain_N)
    assert len(native.copies) == 5  # a convolution's weight, two streams' weights and biases
    for ours, theirs in zip(native.copies.items(), learning.copies.items(), strict=True):
        assert torch.equal(ours[0], theirs[0])
        assert torch.equal(ours[1], theirs[1])


@pytest.mark.slow
@pytest.mark.parametrize("readout", READOUTS)
def test_memory_of_a_decision_is_freed_without_the_garbage_collector(readout: str) -> None:
    """Its memory is free at once, not when Python looks for cycles."""
    _, native, x = decision(readout)
    held = weakref.ref(x)
    gc.collect()
    gc.disable()
    try:
        values = native.decide(x, native.for_task(0), training=True, other_inputs=[x])
        values[0].sum().backward()
        del x, values
        assert held() is None
    finally:
        gc.enable()


def test_backward_runs_once_and_only_with_the_parameters_of_its_decision() -> None:
    network, native, x = decision("mean")
    parameters = list(network.parameters())
    (q,) = native.decide(x, native.for_task(0), training=True)
    (other,) = native.decide(x * 0.5, native.for_task(1), training=True)
    late = torch.autograd.grad(q.square().sum(), parameters, retain_graph=True)
    (q_again,) = native.decide(x, native.for_task(0), training=True)
    for ours, theirs in zip(late, torch.autograd.grad(q_again.square().sum(), parameters), strict=True):
        assert torch.equal(ours, theirs)
    with pytest.raises(RuntimeError, match="a second backward"):
        q.sum().backward()
    with torch.no_grad():
        parameters[0].add_(1.0)
    with pytest.raises(RuntimeError, match="parameters have changed"):
        other.sum().backward()


@pytest.mark.parametrize("task", [-1, 3])
def test_an_unknown_task_is_refused(task: int) -> None:
    _, native, _ = decision("mean")
    with pytest.raises(IndexError, match=f"task {task}, expected 0 to 2"):
        native.for_task(task)


@pytest.mark.skipif(not HAS_BITS, reason="no AVX-512")
@pytest.mark.parametrize("trunk", ["nature", "minatar", "mlp"])
@pytest.mark.parametrize("encoding", ["direct", "rate"])
def test_networks_without_bits_compute_the_same_to_rounding(
    trunk: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Q-values and gradients of spikes as bits are those of dense spikes, to rounding."""
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
        (q,) = native.decide(inputs, native.for_task(0), training=True)
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


@pytest.mark.slow
@pytest.mark.parametrize("method", ["SwitchMT", "DSQN_D", "MTSpark_AD"])
@pytest.mark.parametrize("dendrites", ["shared", "per_neuron"])
def test_normalized_streams_equal_eager(method: str, dendrites: str) -> None:
    """Q-values of training and of other inputs, gradients, and running statistics of the batch's task only."""
    spec = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
    settings_ = {"method": method, "trunk": "minatar", "stream_normalization": "batch", "threshold": 0.4}
    settings_["stream_current_thresholds"] = 0.6
    settings_ |= {} if method == "DSQN_D" else {"dendrites": dendrites}
    config = resolve(small_config(network=settings_)).network
    ours, theirs = build_network(config, spec, 1), build_network(config, spec, 1)
    native, generator = NativeNetwork(ours, None), torch.Generator()
    for step in range(3):
        x, other = torch.rand(2, 16, 4, 10, 10, generator=torch.Generator().manual_seed(step))
        context = theirs.context(1)
        with torch.no_grad():
            expected_other = theirs.decide(theirs.encode(other), context, training=False)
        expected = theirs.decide(theirs.encode(x), context, training=True)
        inputs = [native.inputs(part, generator) for part in (x, other)]
        q, q_other = native.decide(inputs[0], native.for_task(1), training=True, other_inputs=[inputs[1]])
        torch.testing.assert_close(q, expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(q_other, expected_other, rtol=1e-4, atol=1e-5)
        for network, values in ((ours, q), (theirs, expected)):
            network.zero_grad()
            values.square().mean().backward()
        for (name, one), two in zip(ours.named_parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(one.grad, two.grad, rtol=1e-3, atol=1e-6, msg=name)
        for name, value in theirs.named_buffers():
            torch.testing.assert_close(ours.get_buffer(name), value, rtol=1e-4, atol=1e-6, msg=name)
    for stream in ours.streams.values():
        moved = [bool(stream.normalization.running_mean_KC[task].any()) for task in range(3)]
        assert moved == [False, True, False]
