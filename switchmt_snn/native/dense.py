"""Products of numbers: in bfloat16 those of ``native_bfloat16.cpp``, where the processor has AVX512-BF16 but no AMX and
the sizes fit; else PyTorch's (oneDNN). Images have their channels innermost in memory. Sums are float32 in both; what
is returned in float32 is not rounded in C++.

Shapes: I images, H, W places, C channels in, O channels out.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from switchmt_snn.native.library import library
from switchmt_snn.native.supports import has_amx

_CHANNELS = 32
"""Output channels that C++ sums together; a product's must be a multiple of it."""


def convolution(x_ICHW: Tensor, weight: Tensor, bias_O: Tensor, stride: int) -> Tensor:
    """``[I, O, h, w]``, without padding; the bias is float32."""
    if not _fits(x_ICHW, weight, channels=weight.shape[0], even_length=weight.shape[1] * weight.shape[2]):
        return channels_last(F.conv2d(x_ICHW, weight, bias_O.to(x_ICHW.dtype), stride))
    if bias_O.dtype != torch.float32 or bias_O.shape != weight.shape[:1]:
        raise ValueError(f"bias {bias_O.dtype} {tuple(bias_O.shape)}, expected float32 for {len(weight)} channels")
    x, weight, sizes = channels_last(x_ICHW), channels_last(weight), _sizes(x_ICHW, weight, stride)
    bias_O = bias_O.contiguous()
    sides = (out_side(side, weight.shape[2], stride) for side in x.shape[2:])
    y_IhwO = torch.empty(x.shape[0], *sides, weight.shape[0], dtype=x.dtype)
    library().snn_convolve(x.data_ptr(), weight.data_ptr(), bias_O.data_ptr(), y_IhwO.data_ptr(), *sizes)
    return y_IhwO.permute(0, 3, 1, 2)


def convolution_weight_gradient(x_ICHW: Tensor, grad_y: Tensor, weight: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Of weight and bias, float32, from that of the products ``[I, O, h, w]``."""
    out_channels, channels, kernel, _ = weight.shape
    if not _fits(x_ICHW, grad_y, channels=out_channels):
        how = ([out_channels], [stride] * 2, [0, 0], [1, 1], False, [0, 0], 1, [False, True, True])
        _, grad_weight, grad_bias = torch.ops.aten.convolution_backward(grad_y, x_ICHW, weight, *how)
        return grad_weight.to(torch.float32), grad_bias.to(torch.float32)
    _require_outputs(grad_y, (len(x_ICHW), *x_ICHW.shape[2:]), weight, stride)
    x, grad_y, sizes = channels_last(x_ICHW), channels_last(grad_y), _sizes(x_ICHW, weight, stride)
    grad_OkkC, grad_O = torch.empty(out_channels, kernel, kernel, channels), torch.empty(out_channels)
    places = (x.data_ptr(), grad_y.data_ptr(), grad_OkkC.data_ptr(), grad_O.data_ptr())
    library().snn_weight_gradient(*places, *sizes)
    return grad_OkkC.permute(0, 3, 1, 2), grad_O


def convolution_input_gradient(grad_y: Tensor, weight: Tensor, stride: int, sides: Sequence[int]) -> Tensor:
    """``[I, C, *sides]`` from that of the products ``[I, O, h, w]``."""
    out_channels, channels, kernel, _ = weight.shape
    unseen, taps = [(side - kernel) % stride for side in sides], kernel // stride
    has_phases = kernel % stride == 0 and not any(unseen)
    grad_y = channels_last(grad_y)
    if has_phases and _fits(grad_y, weight, channels=channels, even_length=out_channels):
        _require_outputs(grad_y, (len(grad_y), *sides), weight, stride)
        weight, height, width = channels_last(weight), sides[0] // stride, sides[1] // stride
        grad_IHWC = torch.empty(grad_y.shape[0], *sides, channels, dtype=grad_y.dtype)
        sizes = (grad_y.shape[0], height, width, out_channels, channels, taps, stride, torch.get_num_threads())
        library().snn_input_gradient(grad_y.data_ptr(), weight.data_ptr(), grad_IHWC.data_ptr(), *sizes)
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
    """``[M, N]``."""
    (rows, inner), columns = a_MK.shape, b_KN.shape[1]
    if not _fits(a_MK, b_KN, channels=columns, even_length=inner):
        return a_MK @ b_KN
    if len(b_KN) != inner:
        raise ValueError(f"matrices {tuple(a_MK.shape)} and {tuple(b_KN.shape)}, expected equal inner sizes")
    a_MK, b_KN, out_MN = a_MK.contiguous(), b_KN.contiguous(), torch.empty(rows, columns, dtype=a_MK.dtype)
    sizes = (rows, inner, columns, torch.get_num_threads())
    library().snn_matrix_product(a_MK.data_ptr(), b_KN.data_ptr(), out_MN.data_ptr(), *sizes)
    return out_MN


def channels_last(x: Tensor) -> Tensor:
    """The same numbers, those of images with channels innermost."""
    return x.contiguous(memory_format=torch.channels_last) if x.dim() == 4 else x


def out_side(side: int, kernel: int, stride: int) -> int:
    """Places of a convolution without padding."""
    return (side - kernel) // stride + 1


def _fits(*factors: Tensor, channels: int, even_length: int = 0) -> bool:
    """Whether ``native_bfloat16.cpp`` is used for sums of so many channels over such a length."""
    is_here = all(x.dtype == torch.bfloat16 and x.is_cpu for x in factors)
    sizes_fit = channels % _CHANNELS == 0 and even_length % 2 == 0
    return is_here and sizes_fit and bool(library().snn_has_bfloat16()) and not has_amx()


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
