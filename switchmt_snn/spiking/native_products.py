"""Synaptic products with their gradients. Those of spikes that are kept as bits are float32 sums of weights
(``native_products.cpp``, AVX-512), at several times the speed of multiplications; all others are PyTorch's (oneDNN).

Shapes: T steps, B batch, I = T * B images, H, W places, C channels in, O channels out, K inputs of an output.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.spiking.native import Spikes
from switchmt_snn.spiking.native_library import library, typed

_LANES = 64


def has_spike_products() -> bool:
    """Whether this machine's processor has the instructions for products of bits."""
    return bool(library().snn_has_products())


class Synapses(NamedTuple):
    """A layer's synapses: its parameters, and what they are in the products' dtype, channels innermost."""

    layer: nn.Linear | nn.Conv2d
    weight: Tensor
    bias: Tensor
    matrix: Tensor
    """The weights ``[O, bits]`` for products of bits, a convolution's filled up to whole words of channels."""

    @classmethod
    def of(cls, layer: nn.Linear | nn.Conv2d, dtype: torch.dtype) -> Synapses:
        """As the parameters are now."""
        with torch.no_grad():
            weight = matrix = channels_last(layer.weight.to(dtype))
            if weight.dim() == 4:
                matrix = weight.permute(0, 2, 3, 1)
                if missing := -weight.shape[1] % 32:
                    matrix = F.pad(matrix, (0, missing))
                matrix = matrix.flatten(1)
            return cls(layer, weight, cast(Tensor, layer.bias).to(dtype), matrix)

    @property
    def stride(self) -> int:
        """Of a convolution, both ways."""
        return cast(nn.Conv2d, self.layer).stride[0]


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
        lanes = images * _outputs(height, kernel, stride) * _outputs(width, kernel, stride)
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
                f"{tuple(bias_O.shape)}, expected, both contiguous, weights for {self.bits} inputs and as many float32 biases"
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
    weight, bias, stride = synapses.layer.weight, synapses.layer.bias, synapses.stride
    steps, (height, width) = x.numbers.shape[:2], x.numbers.shape[2:4]
    numbers_ICHW = x.numbers.flatten(0, 1).permute(0, 3, 1, 2)
    if x.bits is None:
        what = (numbers_ICHW, weight, bias, synapses.weight, synapses.bias, stride)
        y = _Convolution.apply(*what)  # type: ignore[no-untyped-call]
        return y.permute(0, 2, 3, 1).unflatten(0, steps)  # type: ignore[no-any-return]
    panels = Panels.of_windows(x.bits.flatten(0, 1), weight.shape[-1], stride)
    of_bits = (numbers_ICHW, weight, bias, synapses, panels, stride)
    y = _SpikeConvolution.apply(*of_bits)  # type: ignore[no-untyped-call]
    sides = (_outputs(side, weight.shape[-1], stride) for side in (height, width))
    return y.view(*steps, *sides, -1)  # type: ignore[no-any-return]


class Features:
    """A layer's output as inputs ``[T, B, K]`` of fully connected layers: images ``[T, B, H, W, C]`` in the order
    ``[C, H, W]``, or what already is ``[T, B, K]``."""

    def __init__(self, x: Spikes) -> None:
        self._steps = x.numbers.shape[:2]
        self._numbers = x.numbers.flatten(0, 1).movedim(-1, 1).flatten(1)
        channels = x.numbers.shape[-1]
        self._panels = None if x.bits is None else Panels.of_images(x.bits.flatten(0, 1), channels)

    def connected(self, synapses: Synapses) -> Tensor:
        """A layer's products ``[T, B, O]``."""
        weight, bias = synapses.layer.weight, synapses.layer.bias
        if self._panels is None:
            what = (self._numbers, weight, bias, synapses.weight, synapses.bias)
            y = _Linear.apply(*what)  # type: ignore[no-untyped-call]
        else:
            of_bits = (self._numbers, weight, bias, synapses, self._panels)
            y = _SpikeLinear.apply(*of_bits)  # type: ignore[no-untyped-call]
        return y.unflatten(0, self._steps)  # type: ignore[no-any-return]


def channels_last(x: Tensor) -> Tensor:
    """The same numbers, those of images with channels innermost."""
    return x.contiguous(memory_format=torch.channels_last) if x.dim() == 4 else x


def _words(bits: Tensor) -> int:
    """Where they lie; ValueError for what C++ would read wrongly."""
    if bits.dtype != torch.int32 or not bits.is_cpu or not bits.is_contiguous():
        raise ValueError(f"{bits.dtype} with strides {bits.stride()} on {bits.device}, expected contiguous int32 words")
    return bits.data_ptr()


def _outputs(side: int, kernel: int, stride: int) -> int:
    return (side - kernel) // stride + 1


# All of them take a layer's parameters, which get the gradients, and what was made of the parameters, which is read.


class _SpikeConvolution(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, numbers: Tensor, _: Tensor, bias: Tensor, synapses: Synapses, panels: Panels, stride: int
    ) -> Tensor:
        ctx.save_for_backward(synapses.weight)
        ctx.panels, ctx.stride, ctx.sides = panels, stride, numbers.shape[2:]
        return panels.times(synapses.matrix, bias.detach())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (weight,), grad_y = ctx.saved_tensors, gradients[0].contiguous()
        out_channels, channels, kernel, _ = weight.shape
        outputs = [_outputs(side, kernel, ctx.stride) for side in ctx.sides]
        grad_y_IOhw = grad_y.view(-1, *outputs, out_channels).permute(0, 3, 1, 2)
        grad_x = _input_gradient(grad_y_IOhw, weight, ctx.stride, ctx.sides)
        grad_weight, grad_bias = ctx.panels.gradients(grad_y)
        grad_OkkC = grad_weight.view(out_channels, kernel, kernel, -1)[..., :channels]
        return grad_x, grad_OkkC.permute(0, 3, 1, 2), grad_bias, None, None, None


def _input_gradient(grad_y: Tensor, weight: Tensor, stride: int, sides: tuple[int, int]) -> Tensor:
    """Of a convolution's input ``[I, C, *sides]``, with channels innermost."""
    out_channels, channels, kernel, _ = weight.shape
    unseen = [(side - kernel) % stride for side in sides]
    if stride == 1 or kernel % stride or any(unseen):
        return F.conv_transpose2d(grad_y, weight, stride=stride, output_padding=unseen)
    # Inputs of one phase of the stride see a convolution with stride 1: all phases are its output channels, which
    # oneDNN has in 0.7 of the time.
    taps = kernel // stride
    phased = weight.view(out_channels, channels, taps, stride, taps, stride).permute(3, 5, 1, 0, 2, 4)
    phases = F.conv2d(grad_y, channels_last(phased.flatten(0, 2).flip(2, 3)), padding=taps - 1).permute(0, 2, 3, 1)
    grad_x: Tensor = phases.unflatten(-1, (stride, stride, channels)).transpose(2, 3)
    return grad_x.reshape(-1, *sides, channels).permute(0, 3, 1, 2)


class _SpikeLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numbers: Tensor, _: Tensor, bias: Tensor, synapses: Synapses, panels: Panels) -> Tensor:
        ctx.save_for_backward(synapses.weight)
        ctx.panels = panels
        return panels.times(synapses.matrix, bias.detach())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (weight,), grad_y = ctx.saved_tensors, gradients[0].contiguous()
        return grad_y @ weight, *ctx.panels.gradients(grad_y), None, None


class _Convolution(torch.autograd.Function):
    """Its two gradients are asked for one by one: together, oneDNN takes up to 1.4 times as long."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, _: Tensor, __: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride = stride
        return channels_last(F.conv2d(x, weight, bias, stride))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        grad_y = channels_last(gradients[0])

        def gradient(of_x: bool, of_weight: bool) -> tuple[Tensor, ...]:
            sizes = ([weight.shape[0]], [ctx.stride] * 2, [0, 0], [1, 1], False, [0, 0], 1)
            mask = [of_x, of_weight, of_weight]
            return torch.ops.aten.convolution_backward(grad_y, x, weight, *sizes, mask)  # type: ignore[no-any-return]

        grad_x = gradient(True, False)[0] if ctx.needs_input_grad[0] else None
        grads = (grad.to(torch.float32) for grad in gradient(False, True)[1:])
        return grad_x, *grads, None, None, None


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, _: Tensor, __: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return F.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (x, weight), (grad_y,) = ctx.saved_tensors, gradients
        grad_x = grad_y @ weight if ctx.needs_input_grad[0] else None
        return grad_x, (grad_y.T @ x).to(torch.float32), grad_y.sum(0, dtype=torch.float32), None, None
