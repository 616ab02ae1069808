"""Products of dense values in C++ against PyTorch's in double precision."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.native import dense as native_dense
from switchmt_snn.native import library as native_library
from switchmt_snn.native.dense import (
    channels_last,
    convolution,
    convolution_input_gradient,
    convolution_weight_gradient,
    matrix_product,
)

pytestmark = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")
has_bfloat16 = native_library.problem() is None and bool(native_library.library().snn_has_bfloat16())


def close(ours: Tensor, exact: Tensor, rounded: bool, terms: int = 1, partial_sums: int = 1) -> None:
    """Relative to the largest value; partial_sums: of how many sums, each rounded to bfloat16, a value may consist."""
    assert exact.numel() > 0
    scale = max(float(exact.abs().max()), terms**0.5)  # of so many normal numbers, which may cancel
    torch.testing.assert_close(
        ours.double(),
        exact,
        rtol=5e-3 if rounded else 1e-5,
        atol=scale * (4e-3 * partial_sums**0.5 if rounded else 2e-6),
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@settings(max_examples=60, deadline=None)
@given(
    images=st.integers(1, 20),
    channels=st.sampled_from([1, 2, 3, 4, 12, 32, 64]),
    sides=st.tuples(st.integers(4, 17), st.integers(4, 17)),
    kernel=st.integers(1, 4),
    stride=st.integers(1, 3),
    outputs=st.sampled_from([2, 5, 16, 32, 64, 96]),
    seed=st.integers(0, 2**31),
)
@example(images=3, channels=4, sides=(20, 24), kernel=8, stride=4, outputs=32, seed=0)  # those of the nature trunk
@example(images=3, channels=32, sides=(20, 20), kernel=4, stride=2, outputs=64, seed=0)
@example(images=3, channels=64, sides=(9, 9), kernel=3, stride=1, outputs=64, seed=0)
@example(images=2, channels=32, sides=(5, 3), kernel=3, stride=1, outputs=32, seed=0)  # lines of other lengths
@example(images=2, channels=32, sides=(4, 12), kernel=3, stride=1, outputs=2, seed=0)
@example(images=2, channels=64, sides=(6, 26), kernel=4, stride=2, outputs=32, seed=0)
def test_convolutions_and_their_gradients(dtype, images, channels, sides, kernel, stride, outputs, seed) -> None:
    """Also of sizes that C++ has no code for."""
    torch.manual_seed(seed)
    x = torch.randn(images, channels, *sides).to(dtype)
    weight, bias = channels_last(torch.randn(outputs, channels, kernel, kernel).to(dtype)), torch.randn(outputs)
    rounded = dtype == torch.bfloat16
    y = convolution(x, weight, bias, stride)
    close(y, F.conv2d(x.double(), weight.double(), bias.double(), stride), rounded)
    assert y.permute(0, 2, 3, 1).is_contiguous()
    grad_y = torch.randn(y.shape).to(dtype)
    grad_x = convolution_input_gradient(grad_y, weight, stride, sides)
    # Without bfloat16 instructions, PyTorch adds the products of each kernel position, and of each image, in bfloat16.
    positions, image_sums = (1, 1) if has_bfloat16 else (math.ceil(kernel / stride) ** 2, images)
    exact = torch.nn.grad.conv2d_input(x.shape, weight.double(), grad_y.double(), stride)
    close(grad_x, exact, rounded, partial_sums=positions)
    grad_weight, grad_bias = convolution_weight_gradient(x, grad_y, weight, stride)
    exact = torch.nn.grad.conv2d_weight(x.double(), weight.shape, grad_y.double(), stride)
    terms = grad_y.numel() // outputs
    in_cplusplus = rounded and has_bfloat16 and outputs % 32 == 0 and not native_dense.has_amx()
    close(grad_weight, exact, rounded and not in_cplusplus, terms, image_sums)
    close(grad_bias, grad_y.double().sum((0, 2, 3)), rounded and not in_cplusplus, terms, image_sums)
    assert grad_weight.dtype == grad_bias.dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 40), inner=st.integers(1, 70), columns=st.sampled_from([1, 31, 32, 64, 160]), seed=st.integers()
)
def test_matrix_products(dtype, rows, inner, columns, seed) -> None:
    torch.manual_seed(seed % 2**31)
    a, b = torch.randn(rows, inner).to(dtype), torch.randn(columns, inner).to(dtype).T
    close(matrix_product(a, b), a.double() @ b.double(), dtype == torch.bfloat16)
    close(matrix_product(a, b.contiguous()), a.double() @ b.double(), dtype == torch.bfloat16)


@pytest.mark.skipif(not has_bfloat16, reason="no AVX512-BF16")
def test_with_amx_pytorch_computes_the_products(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native_dense, "has_amx", lambda: True)
    monkeypatch.setattr(native_library.library(), "snn_matrix_product", None)
    a, b = torch.randn(8, 32).bfloat16(), torch.randn(32, 64).bfloat16()
    assert torch.equal(matrix_product(a, b), a @ b)
    monkeypatch.setattr(native_dense, "has_amx", lambda: False)
    with pytest.raises(TypeError):
        matrix_product(a, b)
