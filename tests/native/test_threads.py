"""Every C++ function gives the same bits for any number of threads."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from switchmt_snn.native import dense
from switchmt_snn.native import library as native_library
from switchmt_snn.native.dense import (
    channels_last,
    convolution,
    convolution_input_gradient,
    convolution_weight_gradient,
    matrix_product,
)
from switchmt_snn.native.neurons import Currents, batch_moments
from switchmt_snn.native.panels import Panels
from switchmt_snn.native.streams import Heads
from switchmt_snn.native.supports import spikes_as_bits
from tests.native.networks import network_of, neurons_of
from tests.native.spikes import as_bits, random_spikes

BUILT = native_library.problem() is None
pytestmark = pytest.mark.skipif(not BUILT, reason="no C++ compiler")
multiplies_bits = pytest.mark.skipif(not (BUILT and spikes_as_bits(torch.float32)), reason="no AVX-512")
multiplies_bfloat16 = pytest.mark.skipif(
    not (BUILT and native_library.library().snn_has_bfloat16()), reason="no AVX512-BF16"
)

Call = Callable[[], tuple[Tensor, ...]]


def neurons() -> Call:
    layer, currents = neurons_of(4), Currents(torch.ones(48))
    y, grad = torch.randn(4, 333, 48), torch.randn(4, 333, 48)

    def call() -> tuple[Tensor, ...]:
        spikes, currents_4C = layer.fire(y, currents, "float32")
        return spikes, *layer.fire_backward(y, currents_4C, grad), *batch_moments(y)

    return call


def heads() -> Call:
    layer, spikes, grad = Heads(network_of()), torch.rand(3, 40, 74), torch.randn(3, 40, 6)
    matrix = layer.of_task(0)

    def call() -> tuple[Tensor, ...]:
        grad_spikes, of_heads = layer.gradients(spikes, grad, 1.0, matrix)
        return matrix.outputs(spikes), grad_spikes, *of_heads

    return call


def panels(lanes: int, outputs: int) -> Call:
    words, weight = as_bits(random_spikes(lanes, 3, 40)), torch.randn(outputs, 120)
    grad = torch.randn(lanes, outputs)

    def call() -> tuple[Tensor, ...]:
        matrix = Panels.of_images(words, 40)
        return matrix.times(weight, torch.ones(outputs)), *matrix.gradients(grad)

    return call


def bfloat16() -> Call:
    x, weight = torch.randn(21, 4, 20, 20).bfloat16(), channels_last(torch.randn(32, 4, 8, 8).bfloat16())
    grad, deep = torch.randn(21, 32, 4, 4).bfloat16(), channels_last(torch.randn(32, 64, 4, 4).bfloat16())
    return lambda: (
        convolution(x, weight, torch.ones(32), 4),
        *convolution_weight_gradient(x, grad, weight, 4),
        convolution_input_gradient(grad, deep, 2, (10, 10)),
        matrix_product(x.flatten(1), torch.ones(1600, 96).bfloat16()),
    )


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(neurons, id="neurons"),
        pytest.param(heads, id="heads"),
        pytest.param(lambda: panels(700, 52), id="panels divided by outputs", marks=multiplies_bits),
        pytest.param(lambda: panels(2500, 3), id="panels divided by lanes", marks=multiplies_bits),
        pytest.param(bfloat16, id="bfloat16", marks=multiplies_bfloat16),
    ],
)
def test_any_number_of_threads_gives_the_same_bits(make: Callable[[], Call], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "has_amx", lambda: False)
    call, threads, results = make(), torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            results.append(call())
    finally:
        torch.set_num_threads(threads)
    assert len(results[0]) > 0
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
