"""Synaptic products with their gradients. Those of spikes that are kept as bits are float32 sums of weights
(``native_products.cpp``, AVX-512), at some three times the speed of float32 multiplications; all others are of numbers
(:mod:`~switchmt_snn.spiking.native_dense`).

Shapes: T steps, B batch, I = T * B images, H, W places, C channels in, O channels out, K inputs of an output.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.spiking.native import Spikes
from switchmt_snn.spiking.native_dense import (
    convolution,
    convolution_input_gradient,
    convolution_weight_gradient,
    has_amx,
    matrix_product,
    out_side,
)
from switchmt_snn.spiking.native_library import library, typed

_LANES = 64


def spikes_as_bits(dtype: torch.dtype) -> bool:
    """Whether products of spikes in a dtype are those of bits here: the processor needs AVX-512, and for bfloat16 no
    AMX."""
    return bool(library().snn_has_products()) and not (dtype == torch.bfloat16 and has_amx())


class Synapses(NamedTuple):
    """Synapses of a layer, or of several fully connected layers with the same inputs, one after the other."""

    parameters: tuple[Tensor, ...]
    """Weight and bias of each layer, which get the gradients."""
    weight: Tensor
    """In the products' dtype, channels innermost."""
    bias: Tensor
    stride: int

    @classmethod
    def of_convolution(cls, layer: nn.Conv2d, dtype: torch.dtype) -> Synapses:
        """As the parameters are now."""
        weight, bias = layer.weight, cast(Tensor, layer.bias)
        rounded = weight.detach().to(dtype, memory_format=torch.channels_last)
        return cls((weight, bias), rounded, bias.detach(), layer.stride[0])

    @classmethod
    def of_linear(cls, layers: Sequence[nn.Linear], weight: Tensor) -> Synapses:
        """As the biases are now; ``weight`` holds the copies of all weights."""
        parameters = tuple(part for layer in layers for part in (layer.weight, layer.bias))
        return cls(parameters, weight, torch.cat(parameters[1::2]).detach(), 0)

    @property
    def matrix(self) -> Tensor:
        """The weights ``[O, bits]`` for products of bits, a convolution's filled up to whole words of channels."""
        if self.weight.dim() == 2:
            return self.weight
        matrix, missing = self.weight.permute(0, 2, 3, 1), -self.weight.shape[1] % 32
        return (F.pad(matrix, (0, missing)) if missing else matrix).flatten(1)


class Panels(NamedTuple):
    """A matrix of spikes ``[lanes, bits]``, as ``native_products.cpp`` describes it."""

    words: Tensor
    lanes: int
    bits: int

    @classmethod
    def empty(cls, lanes: int, bits: int) -> Panels:
        """With memory for its words, not filled."""
        return cls(torch.empty(-(-lanes // _LANES), -(-bits // 32), _LANES, dtype=torch.int32), lanes, bits)

    @classmethod
    def of_windows(cls, bits_IHWw: Tensor, kernel: int, stride: int) -> Panels:
        """A lane for every window of a convolution without padding; its bits are places times whole words.

        Raises:
            ValueError: the words are not contiguous int32.
        """
        images, height, width, words = bits_IHWw.shape
        lanes = images * out_side(height, kernel, stride) * out_side(width, kernel, stride)
        panels = cls.empty(lanes, kernel * kernel * words * 32)
        sizes = (*bits_IHWw.shape, kernel, stride, torch.get_num_threads())
        library().snn_windows(_words(bits_IHWw), panels.words.data_ptr(), *sizes)
        return panels

    @classmethod
    def of_images(cls, bits_Iw: Tensor, channels: int) -> Panels:
        """A lane for every image ``[I, ..., words]``; its bits are in the order ``[C, places]``.

        Raises:
            ValueError: the words are not contiguous int32.
        """
        images, *sides, _ = bits_Iw.shape
        panels = cls.empty(images, channels * math.prod(sides))
        sizes = (images, math.prod(sides), channels, torch.get_num_threads())
        library().snn_flat(_words(bits_Iw), panels.words.data_ptr(), *sizes)
        return panels

    def transposed(self) -> Panels:
        """``[bits, lanes]``."""
        other = Panels.empty(self.bits, self.lanes)
        sizes = (self.lanes, self.bits, torch.get_num_threads())
        library().snn_transpose(self.words.data_ptr(), other.words.data_ptr(), *sizes)
        return other

    def times(self, weight_OK: Tensor, bias_O: Tensor) -> Tensor:
        """``[lanes, O]``: this times weights, and a float32 bias; in the weights' dtype.

        Raises:
            ValueError: weights and bias do not fit, or are not contiguous.
        """
        outputs = weight_OK.shape[0]
        fitting = weight_OK.shape == (outputs, self.bits) and bias_O.shape == (outputs,)
        contiguous = weight_OK.is_contiguous() and bias_O.is_contiguous()
        if not fitting or bias_O.dtype != torch.float32 or not contiguous:
            raise ValueError(
                f"weights {tuple(weight_OK.shape)} with strides {weight_OK.stride()} and bias {bias_O.dtype} "
                f"{tuple(bias_O.shape)}, expected contiguous weights for {self.bits} inputs and as many float32 biases"
            )
        y = torch.empty(self.lanes, outputs, dtype=weight_OK.dtype)
        sizes = (outputs, self.bits, self.lanes, torch.get_num_threads())
        library().snn_multiply(*typed(weight_OK), bias_O.data_ptr(), self.words.data_ptr(), y.data_ptr(), *sizes)
        return y

    def gradients(self, grad_y: Tensor) -> tuple[Tensor, Tensor]:
        """Of the weights ``[O, bits]`` and the bias ``[O]``, float32, from that of the products ``[lanes, O]``.

        Raises:
            ValueError: the gradient does not fit, or is not contiguous.
        """
        if grad_y.dim() != 2 or grad_y.shape[0] != self.lanes or not grad_y.is_contiguous():
            raise ValueError(
                f"gradient {tuple(grad_y.shape)} with strides {grad_y.stride()}, expected contiguous rows for "
                f"{self.lanes} lanes"
            )
        outputs, turned = grad_y.shape[1], self.transposed()
        grad_weight, grad_bias = torch.empty(outputs, self.bits), torch.empty(outputs)
        places = (turned.words.data_ptr(), grad_weight.data_ptr(), grad_bias.data_ptr())
        sizes = (outputs, self.lanes, self.bits, torch.get_num_threads())
        library().snn_multiply_transposed(*typed(grad_y), *places, *sizes)
        return grad_weight, grad_bias


def convolved(x: Spikes, synapses: Synapses) -> Tensor:
    """A convolution's products ``[T, B, h, w, O]``, contiguous, for ``[T, B, H, W, C]``."""
    steps, sides = x.numbers.shape[:2], x.numbers.shape[2:4]
    kernel, stride = synapses.weight.shape[-1], synapses.stride
    numbers_ICHW = x.numbers.flatten(0, 1).permute(0, 3, 1, 2)
    if x.bits is None:
        y = _Convolution.apply(numbers_ICHW, synapses, *synapses.parameters)  # type: ignore[no-untyped-call]
        return y.permute(0, 2, 3, 1).unflatten(0, steps)  # type: ignore[no-any-return]
    panels = Panels.of_windows(x.bits.flatten(0, 1), kernel, stride)
    y = _SpikeConvolution.apply(numbers_ICHW, synapses, panels, *synapses.parameters)  # type: ignore[no-untyped-call]
    return y.view(*steps, *(out_side(side, kernel, stride) for side in sides), -1)  # type: ignore[no-any-return]


def connected(x: Spikes, synapses: Synapses, beside: Sequence[Spikes] = ()) -> list[Tensor]:
    """Products ``[T, B, O]`` of fully connected layers for ``[T, B, K]``, or for images ``[T, B, H, W, C]`` that are
    flattened in the order ``[C, H, W]``; and after them those of others with the same weights, without gradient."""
    everyone = (*beside, x)
    if x.bits is None:
        ys = []
        for one in everyone:
            with torch.set_grad_enabled(one is x and torch.is_grad_enabled()):
                ys.append(_Linear.apply(_flat(one), synapses, *synapses.parameters))  # type: ignore[no-untyped-call]
    else:
        panels = [Panels.of_images(cast(Tensor, one.bits).flatten(0, 1), one.numbers.shape[-1]) for one in everyone]
        ys = _SpikeLinear.apply(_flat(x), synapses, panels, *synapses.parameters)  # type: ignore[no-untyped-call]
    *others, y = (y.unflatten(0, one.numbers.shape[:2]) for y, one in zip(ys, everyone, strict=True))
    return [y, *others]


def _flat(x: Spikes) -> Tensor:
    return x.numbers.flatten(0, 1).movedim(-1, 1).flatten(1)


def _words(bits: Tensor) -> int:
    """Where they lie; ValueError for what C++ would read wrongly."""
    if bits.dtype != torch.int32 or not bits.is_cpu or not bits.is_contiguous():
        raise ValueError(f"{bits.dtype} with strides {bits.stride()} on {bits.device}, expected contiguous int32 words")
    return bits.data_ptr()


# All of them take the layers' parameters last: they get the gradients, and what was made of them is read.


class _SpikeConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numbers: Tensor, synapses: Synapses, panels: Panels, *parameters: Tensor) -> Tensor:
        ctx.synapses, ctx.panels, ctx.sides = synapses, panels, numbers.shape[2:]
        return panels.times(synapses.matrix, synapses.bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        grad_y, weight, stride = gradients[0].contiguous(), ctx.synapses.weight, ctx.synapses.stride
        out_channels, channels, kernel, _ = weight.shape
        places = [out_side(side, kernel, stride) for side in ctx.sides]
        grad_y_IOhw = grad_y.view(-1, *places, out_channels).permute(0, 3, 1, 2)
        grad_x = convolution_input_gradient(grad_y_IOhw, weight, stride, ctx.sides)
        grad_weight, grad_bias = ctx.panels.gradients(grad_y)
        grad_OkkC = grad_weight.view(out_channels, kernel, kernel, -1)[..., :channels]
        return grad_x, None, None, grad_OkkC.permute(0, 3, 1, 2), grad_bias


class _SpikeLinear(torch.autograd.Function):
    """Of several panels, with the same tables; the gradient is the last one's."""

    @staticmethod
    def forward(
        ctx: Any, numbers: Tensor, synapses: Synapses, panels: Sequence[Panels], *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.synapses, ctx.panels = synapses, panels[-1]
        ctx.set_materialize_grads(False)
        words = torch.cat([part.words for part in panels])
        y = Panels(words, len(words) * _LANES, panels[-1].bits).times(synapses.matrix, synapses.bias)
        rows = y.split([len(part.words) * _LANES for part in panels])
        parts = tuple(some[: part.lanes] for some, part in zip(rows, panels, strict=True))
        ctx.mark_non_differentiable(*parts[:-1])
        return parts

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        grad_y = gradients[-1].contiguous()
        grad_x = matrix_product(grad_y, ctx.synapses.weight)
        return grad_x, None, None, *_by_layer(ctx.synapses, *ctx.panels.gradients(grad_y))


def _by_layer(synapses: Synapses, grad_weight: Tensor, grad_bias: Tensor) -> list[Tensor]:
    """Gradients in the order of the parameters."""
    sizes = [bias.shape[0] for bias in synapses.parameters[1::2]]
    pairs = zip(grad_weight.split(sizes), grad_bias.split(sizes), strict=True)
    return [gradient for pair in pairs for gradient in pair]


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, synapses: Synapses, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        ctx.synapses = synapses
        return convolution(x, synapses.weight, synapses.bias, synapses.stride)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        # Its two gradients are asked for one by one: together, oneDNN takes up to 1.4 times as long.
        (x,), (grad_y,), (weight, stride) = ctx.saved_tensors, gradients, (ctx.synapses.weight, ctx.synapses.stride)
        is_asked = ctx.needs_input_grad[0]
        grad_x = convolution_input_gradient(grad_y, weight, stride, x.shape[2:]) if is_asked else None
        return grad_x, None, *convolution_weight_gradient(x, grad_y, weight, stride)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, synapses: Synapses, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        ctx.synapses = synapses
        return F.linear(x, synapses.weight, synapses.bias.to(x.dtype))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (x,), (grad_y,) = ctx.saved_tensors, gradients
        grad_x = matrix_product(grad_y, ctx.synapses.weight) if ctx.needs_input_grad[0] else None
        both = (grad_y.T @ x).to(torch.float32), grad_y.sum(0, dtype=torch.float32)
        return grad_x, None, *_by_layer(ctx.synapses, *both)
