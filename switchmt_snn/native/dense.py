"""Products of dense values.

In bfloat16, ``csrc/dense_bfloat16.cpp`` computes them if the processor has AVX512-BF16 but no AMX and the sizes fit;
else PyTorch does (oneDNN). Images have their channels innermost in memory. Sums are float32 in both. Results that are
returned in float32 are not rounded in C++.

Shapes: I images, H, W sides, C channels in, O channels out.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from switchmt_snn.native.library import library
from switchmt_snn.native.pointers import BFLOAT16, FLOAT32, pointer
from switchmt_snn.native.supports import has_amx

_CHANNELS = 32
"""Output channels that C++ sums together; a product's must be a multiple of it."""


def convolution(x_ICHW: Tensor, weight: Tensor, bias_O: Tensor, stride: int) -> Tensor:
    """``[I, O, h, w]``, without padding; the bias is float32.

    Raises:
        ValueError: weights or bias do not fit the images.
    """
    if not _fits(x_ICHW, weight, channels=weight.shape[0], even_length=weight.shape[1] * weight.shape[2]):
        return channels_last(F.conv2d(x_ICHW, weight, bias_O.to(x_ICHW.dtype), stride))
    x, weight, sizes = channels_last(x_ICHW), channels_last(weight), _sizes(x_ICHW, weight, stride)
    sides = (out_side(side, weight.shape[2], stride) for side in x.shape[2:])
    y_IhwO = torch.empty(x.shape[0], *sides, weight.shape[0], dtype=x.dtype)
    bias = pointer(bias_O.contiguous(), FLOAT32, (len(weight),))
    library().snn_convolve(_image_pointer(x), _image_pointer(weight), bias, y_IhwO.data_ptr(), *sizes)
    return y_IhwO.permute(0, 3, 1, 2)


def convolution_weight_gradient(x_ICHW: Tensor, grad_y: Tensor, weight: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Gradients of weight and bias, float32, from that of the products ``[I, O, h, w]``.

    Raises:
        ValueError: the gradient does not fit the images.
    """
    out_channels, channels, kernel, _ = weight.shape
    if not _fits(x_ICHW, grad_y, channels=out_channels):
        options = ([out_channels], [stride] * 2, [0, 0], [1, 1], False, [0, 0], 1, [False, True, True])
        _, grad_weight, grad_bias = torch.ops.aten.convolution_backward(grad_y, x_ICHW, weight, *options)
        return grad_weight.to(torch.float32), grad_bias.to(torch.float32)
    _require_outputs(grad_y, (len(x_ICHW), *x_ICHW.shape[2:]), weight, stride)
    x, grad_y, sizes = channels_last(x_ICHW), channels_last(grad_y), _sizes(x_ICHW, weight, stride)
    grad_OkkC, grad_O = torch.empty(out_channels, kernel, kernel, channels), torch.empty(out_channels)
    gradients = (grad_OkkC.data_ptr(), grad_O.data_ptr())
    library().snn_convolve_weight_gradient(_image_pointer(x), _image_pointer(grad_y), *gradients, *sizes)
    return grad_OkkC.permute(0, 3, 1, 2), grad_O


def convolution_input_gradient(grad_y: Tensor, weight: Tensor, stride: int, sides: Sequence[int]) -> Tensor:
    """Gradient of the images ``[I, C, *sides]`` from that of the products ``[I, O, h, w]``.

    Raises:
        ValueError: the gradient does not fit the sides.
    """
    out_channels, channels, kernel, _ = weight.shape
    unseen, taps = [(side - kernel) % stride for side in sides], kernel // stride
    has_phases = kernel % stride == 0 and not any(unseen)
    grad_y = channels_last(grad_y)
    if has_phases and _fits(grad_y, weight, channels=channels, even_length=out_channels):
        _require_outputs(grad_y, (len(grad_y), *sides), weight, stride)
        weight, height, width = channels_last(weight), sides[0] // stride, sides[1] // stride
        grad_IHWC = torch.empty(grad_y.shape[0], *sides, channels, dtype=grad_y.dtype)
        sizes = (grad_y.shape[0], height, width, out_channels, channels, taps, stride, torch.get_num_threads())
        pointers = (_image_pointer(grad_y), _image_pointer(weight), grad_IHWC.data_ptr())
        library().snn_convolve_input_gradient(*pointers, *sizes)
        return grad_IHWC.permute(0, 3, 1, 2)
    if not has_phases or stride == 1:
        return F.conv_transpose2d(grad_y, weight, stride=stride, output_padding=unseen)
    # Inputs of one phase of the stride see a convolution with stride 1: all phases are its output channels, which
    # oneDNN has in 0.7 of the time.
    phased = weight.view(out_channels, channels, taps, stride, taps, stride).permute(3, 5, 1, 0, 2, 4)
    phases = F.conv2d(grad_y, channels_last(phased.flatten(0, 2).flip(2, 3)), padding=taps - 1).permute(0, 2, 3, 1)
    grad_x: Tensor = phases.unflatten(-1, (stride, stride, channels)).transpose(2, 3)
    return grad_x.reshape(-1, *sides, channels).permute(0, 3, 1, 2)


def matrix_product(a_MK: Tensor, b_KN: Tensor) -> Tensor:
    """``[M, N]``.

    Raises:
        ValueError: the inner sizes differ.
    """
    (rows, inner), columns = a_MK.shape, b_KN.shape[1]
    if not _fits(a_MK, b_KN, channels=columns, even_length=inner):
        return a_MK @ b_KN
    a_MK, b_KN, out_MN = a_MK.contiguous(), b_KN.contiguous(), torch.empty(rows, columns, dtype=a_MK.dtype)
    factors = (pointer(a_MK, BFLOAT16), pointer(b_KN, BFLOAT16, (inner, columns)))
    library().snn_matrix_product(*factors, out_MN.data_ptr(), rows, inner, columns, torch.get_num_threads())
    return out_MN


def channels_last(x: Tensor) -> Tensor:
    """The same values; those of images with channels innermost in memory."""
    return x.contiguous(memory_format=torch.channels_last) if x.dim() == 4 else x


def out_side(side: int, kernel: int, stride: int) -> int:
    """Side of a convolution's output without padding."""
    return (side - kernel) // stride + 1


def _image_pointer(x_ICHW: Tensor) -> int:
    """Of bfloat16 images with channels innermost."""
    return pointer(x_ICHW.permute(0, 2, 3, 1), BFLOAT16)


def _fits(*factors: Tensor, channels: int, even_length: int = 0) -> bool:
    """Whether C++ has code for sums of so many channels over such a length."""
    is_bf16 = all(x.dtype == torch.bfloat16 and x.is_cpu for x in factors)
    sizes_fit = channels % _CHANNELS == 0 and even_length % 2 == 0
    return is_bf16 and sizes_fit and bool(library().snn_has_bfloat16()) and not has_amx()


def _require_outputs(grad_y: Tensor, inputs_IHW: tuple[int, ...], weight: Tensor, stride: int) -> None:
    images, *sides = inputs_IHW
    shape = (images, len(weight), *(out_side(side, weight.shape[2], stride) for side in sides))
    if grad_y.shape != shape:
        raise ValueError(f"gradient of products {tuple(grad_y.shape)}, expected {shape}")


def _sizes(x_ICHW: Tensor, weight: Tensor, stride: int) -> tuple[int, ...]:
    images, channels, height, width = x_ICHW.shape
    kernel = weight.shape[2]
    if weight.shape[1:] != (channels, kernel, kernel) or kernel > min(height, width):
        raise ValueError(f"weights {tuple(weight.shape)}, expected square ones for inputs {tuple(x_ICHW.shape)}")
    return images, height, width, channels, weight.shape[0], kernel, stride, torch.get_num_threads()
