"""Tensors that C++ would read wrongly are refused, by every function that takes one."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from switchmt_snn.native import dense
from switchmt_snn.native import library as native_library
from switchmt_snn.native.dense import (
    convolution,
    convolution_input_gradient,
    convolution_weight_gradient,
    matrix_product,
)
from switchmt_snn.native.neurons import Currents, batch_moments, scaled_images
from switchmt_snn.native.panels import Panels
from switchmt_snn.native.pointers import FLOAT32, FLOATS, WORDS, pointer, typed_pointer
from switchmt_snn.native.streams import Gains, Heads
from switchmt_snn.native.supports import spikes_as_bits
from tests.native.networks import network_of, neurons_of, streams_of
from tests.native.spikes import as_bits, random_spikes

BUILT = native_library.problem() is None
builds = pytest.mark.skipif(not BUILT, reason="no C++ compiler")
multiplies_bits = pytest.mark.skipif(not (BUILT and spikes_as_bits(torch.float32)), reason="no AVX-512")
multiplies_bfloat16 = pytest.mark.skipif(
    not (BUILT and native_library.library().snn_has_bfloat16()), reason="no AVX512-BF16"
)


@pytest.mark.parametrize(
    ("x", "dtypes", "shape", "words"),
    [
        (torch.zeros(3).double(), FLOAT32, None, "float64 .* expected contiguous float32 on the CPU"),
        (torch.zeros(3, 2).T, FLOAT32, None, "strides .* expected contiguous"),
        (torch.zeros(3, device="meta"), FLOAT32, None, "on meta, expected .* on the CPU"),
        (torch.zeros(3, 2), FLOAT32, (None, 3), r"\(3, 2\) .* float32 \[\*, 3\]"),
        (torch.zeros(3, 2), FLOAT32, (2,), r"expected contiguous float32 \[2\]"),
        (torch.zeros(3), WORDS, None, "expected contiguous int32"),
        (torch.zeros(3).half(), FLOATS, None, "expected contiguous float32 or bfloat16"),
    ],
)
def test_a_pointer_names_what_is_wrong_with_a_tensor(
    x: Tensor, dtypes: tuple[torch.dtype, ...], shape: tuple[int | None, ...] | None, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        pointer(x, dtypes, shape)


def test_a_pointer_to_a_fitting_tensor_is_its_address() -> None:
    x = torch.zeros(4, 3)
    assert pointer(x[1:], FLOAT32, (None, 3)) == x.data_ptr() + 12
    assert typed_pointer(x) == (x.data_ptr(), 0)
    assert typed_pointer(x.bfloat16())[1] == 1


@builds
@pytest.mark.parametrize(
    "y",
    [
        torch.zeros(4, 8, 5).transpose(1, 2),
        torch.zeros(3, 5, 8),
        torch.zeros(4, 5, 8, dtype=torch.float64),
        torch.zeros(4, 5, 8, device="meta"),
    ],
    ids=["transposed", "steps", "float64", "meta"],
)
def test_neurons_refuse_other_currents(y: Tensor) -> None:
    neurons, ones = neurons_of(4), torch.ones(8)
    with pytest.raises(ValueError, match="expected"):
        neurons.fire(y, Currents(ones), "float32")


@builds
@pytest.mark.parametrize("gain_C", [torch.ones(8).double(), torch.ones(1), torch.ones(16)[::2]])
def test_neurons_refuse_other_gains(gain_C: Tensor) -> None:
    with pytest.raises(ValueError, match=r"expected contiguous float32 \[8\]"):
        neurons_of(4).fire(torch.zeros(4, 5, 8), Currents(gain_C), "float32")


@builds
@pytest.mark.parametrize(
    ("currents_4C", "grad"),
    [
        (torch.zeros(4, 8), torch.zeros(1, 5, 8)),
        (torch.zeros(4, 8), torch.zeros(4, 5, 8).bfloat16()),
        (torch.zeros(3, 8), torch.zeros(4, 5, 8)),
    ],
)
def test_neurons_refuse_other_gradients(currents_4C: Tensor, grad: Tensor) -> None:
    with pytest.raises(ValueError, match="expected"):
        neurons_of(4).fire_backward(torch.zeros(4, 5, 8), currents_4C, grad)


@builds
def test_neurons_refuse_an_unknown_form() -> None:
    with pytest.raises(ValueError, match="form 'words', expected dense, float32, bits or mean"):
        neurons_of(4).fire(torch.zeros(4, 5, 8), Currents(torch.ones(8)), "words")


@builds
def test_moments_and_images_refuse_other_dtypes() -> None:
    with pytest.raises(ValueError, match="expected contiguous float32 or bfloat16"):
        batch_moments(torch.zeros(2, 5, 8).double())
    with pytest.raises(ValueError, match="expected contiguous uint8"):
        scaled_images(torch.zeros(2, 4, 5, 5), 1.0, torch.float32)


@multiplies_bits
@pytest.mark.parametrize(
    ("weight", "bias"),
    [
        (torch.zeros(8, 39), torch.zeros(8)),
        (torch.zeros(8, 40), torch.zeros(7)),
        (torch.zeros(8, 40), torch.zeros(8).double()),
        (torch.zeros(40, 8).T, torch.zeros(8)),
        (torch.zeros(8, 40), torch.zeros(16)[::2]),
        (torch.zeros(8, 40).double(), torch.zeros(8)),
    ],
)
def test_panels_refuse_other_weights(weight: Tensor, bias: Tensor) -> None:
    with pytest.raises(ValueError, match="expected"):
        Panels.of_images(as_bits(random_spikes(6, 1, 40)), 40).times(weight, bias)


@multiplies_bits
@pytest.mark.parametrize("grad_y", [torch.zeros(5, 8), torch.zeros(8, 6).T, torch.zeros(6, 8, dtype=torch.float64)])
def test_panels_refuse_other_gradients(grad_y: Tensor) -> None:
    with pytest.raises(ValueError, match="expected"):
        Panels.of_images(as_bits(random_spikes(6, 1, 40)), 40).gradients(grad_y)


@multiplies_bits
@pytest.mark.parametrize("words", [torch.zeros(2, 3, 1), torch.zeros(2, 3, 2, dtype=torch.int32)[..., :1]])
def test_panels_refuse_what_are_no_words(words: Tensor) -> None:
    for make in (lambda: Panels.of_images(words, 3), lambda: Panels.of_windows(words[None], 1, 1)):
        with pytest.raises(ValueError, match="expected contiguous int32"):
            make()


@builds
@pytest.mark.parametrize(
    "spikes",
    [torch.zeros(1, 4, 73), torch.zeros(1, 4, 74).double(), torch.zeros(1, 4, 148)[..., ::2]],
    ids=["neurons", "float64", "strided"],
)
def test_heads_refuse_other_spikes(spikes: Tensor) -> None:
    heads = Heads(network_of())
    matrix = heads.of_task(0)
    for action in (lambda: matrix.outputs(spikes), lambda: heads.gradients(spikes, torch.zeros(1, 4, 6), 1.0, matrix)):
        with pytest.raises(ValueError, match=r"expected contiguous float32 \[\*, \*, 74\]"):
            action()


@builds
@pytest.mark.parametrize("grad", [torch.zeros(1, 4, 7), torch.zeros(1, 3, 6), torch.zeros(1, 4, 6).double()])
def test_heads_refuse_other_gradients(grad: Tensor) -> None:
    heads = Heads(network_of())
    with pytest.raises(ValueError, match=r"expected contiguous float32 \[1, 4, 6\]"):
        heads.gradients(torch.zeros(1, 4, 74), grad, 1.0, heads.of_task(0))


@builds
def test_gains_refuse_segments_and_gradients_of_another_dtype() -> None:
    with pytest.raises(ValueError, match="expected contiguous float32"):
        Gains(streams_of(network_of().double())).of_task(0)
    with pytest.raises(ValueError, match=r"expected contiguous float32 \[74\]"):
        Gains(streams_of(network_of())).gradients(0, torch.zeros(74).double())


X, WEIGHT, BIAS = torch.zeros(2, 4, 9, 9).bfloat16(), torch.zeros(32, 4, 3, 3).bfloat16(), torch.zeros(32)
GRAD_Y = torch.zeros(2, 32, 7, 7).bfloat16()
DENSE: dict[str, tuple[Callable[[], object], str]] = {
    "channels": (lambda: convolution(X, WEIGHT[:, :2], BIAS, 1), "expected square ones"),
    "kernel": (lambda: convolution(X, WEIGHT[..., :2], BIAS, 1), "expected square ones"),
    "large kernel": (lambda: convolution(X, torch.zeros(32, 4, 10, 10).bfloat16(), BIAS, 1), "expected square ones"),
    "biases": (lambda: convolution(X, WEIGHT, BIAS[:8], 1), r"expected contiguous float32 \[32\]"),
    "bias dtype": (lambda: convolution(X, WEIGHT, BIAS.double(), 1), r"expected contiguous float32 \[32\]"),
    "gradient images": (lambda: convolution_weight_gradient(X, GRAD_Y[:1], WEIGHT, 1), "gradient of products"),
    "gradient sides": (lambda: convolution_weight_gradient(X, GRAD_Y[..., :5], WEIGHT, 1), "gradient of products"),
    "input sides": (
        lambda: convolution_input_gradient(GRAD_Y, torch.zeros(32, 32, 3, 3).bfloat16(), 1, (8, 9)),
        "gradient of products",
    ),
    "inner sizes": (
        lambda: matrix_product(torch.zeros(4, 8).bfloat16(), torch.zeros(6, 32).bfloat16()),
        r"expected contiguous bfloat16 \[8, 32\]",
    ),
}


@multiplies_bfloat16
@pytest.mark.parametrize("case", DENSE)
def test_dense_products_refuse_other_factors(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "has_amx", lambda: False)
    call, words = DENSE[case]
    with pytest.raises(ValueError, match=words):
        call()


@multiplies_bfloat16
def test_mixed_dtypes_are_left_to_pytorch_which_refuses_them() -> None:
    with pytest.raises(RuntimeError):
        matrix_product(torch.zeros(4, 8).bfloat16(), torch.zeros(8, 32))
