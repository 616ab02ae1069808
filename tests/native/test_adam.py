"""Adam in C++ against PyTorch's."""

from __future__ import annotations

import copy

import pytest
import torch

from switchmt_snn.native import library as native_library
from switchmt_snn.native.adam import NativeAdam
from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.spiking.network import ObservationSpec, build_network
from tests.conftest import small_config

pytestmark = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")


@pytest.mark.parametrize("precision", [None, torch.bfloat16])
def test_adam_equals_pytorchs_to_rounding_and_keeps_copies_current(precision: torch.dtype | None) -> None:
    spec = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
    ours, theirs = (build_network(small_config(network={"trunk": "minatar"}).network, spec, 1) for _ in range(2))
    native = NativeNetwork(ours, precision)
    optimizers = (
        NativeAdam(ours.parameters(), 1e-2, 1e-5, native),
        torch.optim.Adam(theirs.parameters(), lr=1e-2, eps=1e-5, fused=True),
    )
    for number in range(5):
        native.for_task(0)
        for index, (our, their) in enumerate(zip(ours.parameters(), theirs.parameters(), strict=True)):
            grad = torch.randn(our.shape) * 10.0 ** (-index)
            grad = grad.contiguous(memory_format=torch.channels_last) if our.dim() == 4 and number % 2 else grad
            our.grad, their.grad = (
                (None, None) if index == number else (grad, grad.clone(memory_format=torch.contiguous_format))
            )
        before = [parameter._version for parameter in ours.parameters()]
        for optimizer in optimizers:
            optimizer.step()
        moved = [parameter._version > old for parameter, old in zip(ours.parameters(), before, strict=True)]
        assert moved.count(False) == 1
        assert len(optimizers[0].state) == len(optimizers[1].state)
        assert native.copies_are_current()
        for part, written in native.copies.items():
            assert torch.equal(written, part.to(written.dtype))
    our_state, their_state = (optimizer.state_dict()["state"] for optimizer in optimizers)
    assert our_state.keys() == their_state.keys()
    for (name, our), their in zip(ours.named_parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(our, their, rtol=1e-5, atol=1e-7, msg=name)
    for index, our in our_state.items():
        assert our.keys() == their_state[index].keys()
        for key in our:
            their_part = their_state[index][key]
            torch.testing.assert_close(our[key], their_part, rtol=1e-5, atol=1e-6 * float(their_part.abs().max()))
    with torch.no_grad():
        next(iter(native.copies)).add_(1.0)
    assert not native.copies_are_current()
    optimizers[0].step()
    assert not native.copies_are_current()
    native.for_task(0)
    assert native.copies_are_current()
    assert all(torch.equal(written, part.to(written.dtype)) for part, written in native.copies.items())
    with pytest.raises(ValueError, match="closure"):
        optimizers[0].step(lambda: 0.0)
    for optimizer, other in (optimizers, optimizers[::-1]):  # each goes on from the other's state
        optimizer.load_state_dict(copy.deepcopy(other.state_dict()))
    state = copy.deepcopy(optimizers[0].state_dict())
    state["state"][0]["exp_avg"] = state["state"][0]["exp_avg"][:1]
    with pytest.raises(ValueError, match=r"exp_avg is .*expected that of a parameter"):
        optimizers[0].load_state_dict(state)
    theirs.load_state_dict(ours.state_dict())
    before = [parameter.detach().clone() for parameter in ours.parameters()]
    for our, their in zip(ours.parameters(), theirs.parameters(), strict=True):
        our.grad = their.grad = torch.randn(our.shape)
    for optimizer in optimizers:  # as it was; and anew, where parameters lie elsewhere
        optimizer.step()
        optimizer.state.clear()
    for parameter in ours.parameters():
        parameter.data = parameter.data.clone()
    for optimizer in optimizers:
        optimizer.step()
    for our, their, old in zip(ours.parameters(), theirs.parameters(), before, strict=True):
        assert not torch.equal(our, old)
        torch.testing.assert_close(our, their, rtol=1e-5, atol=1e-6)
    assert optimizers[0].state_dict()["state"].keys() == optimizers[1].state_dict()["state"].keys()
