"""Gains and heads in C++ against the network's own operations."""

from __future__ import annotations

from typing import cast

import pytest
import torch

from switchmt_snn.native import library as native_library
from switchmt_snn.native.streams import Gains, Heads
from tests.native.networks import network_of, streams_of

pytestmark = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")


@pytest.mark.parametrize("dendrites", ["shared", "per_neuron"])
@pytest.mark.parametrize("gating", ["max", "absolute_max"])
@pytest.mark.parametrize("equal", [False, True])
def test_gains_are_those_of_the_dendrites(dendrites: str, gating: str, equal: bool) -> None:
    """With their gradients, also where two segments have the largest response."""
    streams = streams_of(network_of(dendrites=dendrites, dendritic_gating=gating))
    for stream in streams:
        assert stream.dendrites is not None
        with torch.no_grad():
            stream.dendrites.segments_NSK.normal_()
            if equal:
                stream.dendrites.segments_NSK[:, 1] = stream.dendrites.segments_NSK[:, 2]
    gains, weights = Gains(streams), torch.randn(74)
    for task in (0, 2):
        theirs = torch.cat([cast(torch.nn.Module, stream.dendrites)(task).expand(37) for stream in streams])
        torch.testing.assert_close(gains.of_task(task), theirs.detach(), rtol=1e-6, atol=1e-7)
        their_gradients = torch.autograd.grad((theirs * weights).sum(), gains.parameters)
        assert all(gradient.any() for gradient in their_gradients)
        for ours, their in zip(gains.gradients(task, weights), their_gradients, strict=True):
            torch.testing.assert_close(ours, their, rtol=1e-5, atol=1e-6)


def test_a_stream_without_dendrites_has_gains_of_one() -> None:
    gains = Gains(streams_of(network_of(method="DSQN_D")))
    assert torch.equal(gains.of_task(1), torch.ones(74))
    assert gains.parameters == ()
    assert gains.gradients(1, torch.ones(74)) == []


@pytest.mark.parametrize("method", ["DSQN", "SwitchMT"])
@pytest.mark.parametrize(
    ("steps", "batch", "actions", "quantiles"),
    [(1, 32, 6, 1), (4, 3, 18, 1), (2, 5, 1, 1), (1, 11, 6, 4), (2, 2, 18, 32)],
)
@pytest.mark.parametrize("own", ["shared", "per_task"])
def test_heads_are_those_of_the_network(
    method: str, steps: int, batch: int, actions: int, quantiles: int, own: str
) -> None:
    network = network_of(actions, method=method, quantiles=quantiles, heads=own)
    streams, heads = streams_of(network), Heads(network)
    spikes = (torch.rand(steps, batch, 37 * len(streams)) < 0.4).float()
    for task in (0, 2):  # the second time with other parameters
        matrix = heads.of_task(task)
        x = spikes.clone().requires_grad_()
        parts = zip(network.streams, streams, x.split(37, dim=-1), strict=True)
        outputs = {
            name: stream.outputs(part, stream.context(task)).unflatten(-1, (quantiles, -1))
            for name, stream, part in parts
        }
        values = network.combine(outputs)  # [S, B, M, A]
        torch.testing.assert_close(matrix.means(spikes), values.detach().mean(2), rtol=1e-4, atol=1e-5)
        theirs = values.flatten(2)
        torch.testing.assert_close(matrix.outputs(spikes), theirs.detach(), rtol=1e-4, atol=1e-5)
        weights = torch.randn(theirs.shape) * (torch.rand(theirs.shape) < 0.5)  # some outputs without a gradient
        their_gradients = torch.autograd.grad((theirs * weights).sum(), [x, *heads.parameters])
        ours, of_heads = heads.gradients(spikes, weights, 0.25, matrix)
        for our, their in zip((ours * 4, *of_heads), their_gradients, strict=True):
            torch.testing.assert_close(our, their, rtol=1e-4, atol=1e-4)
        with torch.no_grad():
            for part in heads.parameters:
                part.normal_()


def test_heads_of_an_unknown_task_are_refused() -> None:
    heads = Heads(network_of(method="DSQN_D", heads="per_task"))
    for task in (-1, 3):
        with pytest.raises(IndexError, match=f"task {task}, expected 0 to 2"):
            heads.of_task(task)
