"""Synaptic products with their gradients. Those of spikes that are kept as bits are float32 sums of weights
(``native_products.cpp``, AVX-512), at some three times the speed of float32 multiplications; all others are of numbers
(:mod:`~switchmt_snn.native.dense`).

Shapes: T steps, B batch, I = T * B images, H, W places, C channels in, O channels out, K inputs of an output.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from switchmt_snn.native.dense import (
    channels_last,
    convolution,
    convolution_input_gradient,
    convolution_weight_gradient,
    matrix_product,
    out_side,
)
from switchmt_snn.native.library import library, typed
from switchmt_snn.native.neurons import Spikes

_LANES = 64

Gradients = Callable[[Tensor, bool], tuple[Tensor | None, list[Tensor]]]
"""From the gradient of the products (``[I, ..., O]``, contiguous, in their dtype): that of the inputs, if asked for, as
numbers ``[I, ..., C]`` that lie in memory as the inputs do; and those of :attr:`Synapses.parameters`, float32."""


class Synapses:
    """Synapses of a convolution, or of fully connected layers with the same inputs, one after the other.

    Attributes:
        parameters: weight and bias of each layer.
        weight: copies of all weights in the products' dtype, a convolution's with channels innermost.
        bias: all biases.
        stride: a convolution's.
        copies: what was made of parameters by copying, by parameter.
    """

    def __init__(self, layers: Sequence[nn.Linear | nn.Conv2d], dtype: torch.dtype) -> None:
        """Nothing is read yet; see :meth:`read`."""
        weights, biases = [layer.weight for layer in layers], [cast(Tensor, layer.bias) for layer in layers]
        self.parameters = tuple(part for layer in zip(weights, biases, strict=True) for part in layer)
        sizes = [len(weight) for weight in weights]
        outputs, (channels, *kernel) = sum(sizes), weights[0].shape[1:]
        self._memory = torch.empty(outputs, *kernel, channels, dtype=dtype)
        self._missing = -channels % 32 if kernel else 0
        self._flat = self._memory.flatten(1)
        self.weight = self._memory.movedim(-1, 1)
        self.stride = layers[0].stride[0] if isinstance(layers[0], nn.Conv2d) else 0
        self.copies = dict(zip(weights, self.weight.split(sizes), strict=True))
        self.bias = biases[0].detach()
        if len(layers) > 1:
            self.bias = torch.empty(outputs)
            self.copies |= dict(zip(biases, self.bias.split(sizes), strict=True))

    def read(self) -> Synapses:
        """Make the copies those of the parameters as they are now."""
        with torch.no_grad():
            for part, copy in self.copies.items():
                copy.copy_(part)
        return self

    @property
    def matrix(self) -> Tensor:
        """The weights ``[O, bits]`` for products of bits, a convolution's filled up to whole words of channels."""
        return F.pad(self._memory, (0, self._missing)).flatten(1) if self._missing else self._flat


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
    def of_images(cls, bits_Iw: Tensor, channels: int, words: Tensor | None = None) -> Panels:
        """A lane for every image ``[I, ..., words]``; its bits are in the order ``[C, places]``. They are written to
        ``words``, if given, such as a part of :meth:`empty`'s.

        Raises:
            ValueError: words are not contiguous int32, or not as many as needed.
        """
        images, *sides, _ = bits_Iw.shape
        places = math.prod(sides)
        shape = (-(-images // _LANES), -(-channels * places // 32), _LANES)
        words = torch.empty(shape, dtype=torch.int32) if words is None else words
        if words.shape != shape:
            raise ValueError(f"words {tuple(words.shape)}, expected {shape}")
        library().snn_flat(_words(bits_Iw), _words(words), images, places, channels, torch.get_num_threads())
        return cls(words, images, channels * places)

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


def convolved(x: Spikes, synapses: Synapses) -> tuple[Tensor, Gradients]:
    """A convolution's products ``[T, B, h, w, O]``, contiguous, for ``[T, B, H, W, C]``."""
    steps, batch, *sides, _ = x.memory.shape
    weight, stride = synapses.weight, synapses.stride
    outputs, _, kernel, _ = weight.shape
    places = [out_side(side, kernel, stride) for side in sides]
    images = x.memory.flatten(0, 1)
    if x.is_bits:
        panels = Panels.of_windows(images, kernel, stride)
        y = panels.times(synapses.matrix, synapses.bias)
    else:
        numbers_ICHW = images.permute(0, 3, 1, 2)
        y = convolution(numbers_ICHW, weight, synapses.bias, stride).permute(0, 2, 3, 1)

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        # Two gradients are asked for one by one: together, oneDNN takes up to 1.4 times as long.
        grad_x, grad_IOhw = None, grad_y.view(-1, *places, outputs).permute(0, 3, 1, 2)
        if of_inputs:
            grad_ICHW = convolution_input_gradient(grad_IOhw, weight, stride, sides)
            grad_x = channels_last(grad_ICHW).permute(0, 2, 3, 1)
        if not x.is_bits:
            return grad_x, [*convolution_weight_gradient(numbers_ICHW, grad_IOhw, weight, stride)]
        grad_matrix, grad_bias = panels.gradients(grad_y.view(-1, outputs))
        grad_OkkC = grad_matrix.view(outputs, kernel, kernel, -1)[..., : x.channels]
        return grad_x, [grad_OkkC.permute(0, 3, 1, 2), grad_bias]

    return y.view(steps, batch, *places, outputs), gradients


def connected(xs: Sequence[Spikes], synapses: Synapses) -> tuple[list[Tensor], Gradients]:
    """Products ``[T, B, O]`` of fully connected layers for each of some inputs ``[T, B, K]``, or images
    ``[T, B, H, W, C]`` that are flattened in the order ``[C, H, W]``. Gradients are those of the first one."""
    if xs[0].is_bits:
        return _connected_bits(xs, synapses)
    flats = [_flat(x.memory) for x in xs]
    ys = [F.linear(some, synapses.weight, synapses.bias.to(some.dtype)) for some in flats]
    first, flat, shape = xs[0], flats[0], ys[0].shape

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        grad_y = grad_y.view(shape)
        weight, bias = (grad_y.T @ flat).to(torch.float32), grad_y.sum(0, dtype=torch.float32)
        return _input_gradient(first, grad_y, synapses, of_inputs), _by_layer(synapses, weight, bias)

    return [y.view(*x.memory.shape[:2], -1) for x, y in zip(xs, ys, strict=True)], gradients


def _connected_bits(xs: Sequence[Spikes], synapses: Synapses) -> tuple[list[Tensor], Gradients]:
    """All inputs' panels lie one after the other, so they are multiplied with the same tables."""
    images = [x.memory.flatten(0, 1) for x in xs]
    counts = [-(-len(part) // _LANES) for part in images]
    joint = Panels.empty(sum(counts) * _LANES, synapses.matrix.shape[1])
    parts = [
        Panels.of_images(part, x.channels, words)
        for part, x, words in zip(images, xs, joint.words.split(counts), strict=True)
    ]
    rows = joint.times(synapses.matrix, synapses.bias).split([count * _LANES for count in counts])
    ys = [some[: part.lanes].view(*x.memory.shape[:2], -1) for some, part, x in zip(rows, parts, xs, strict=True)]

    first, panels = xs[0], parts[0]

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        grad_y = grad_y.view(panels.lanes, -1)
        grad_x = _input_gradient(first, grad_y, synapses, of_inputs)
        return grad_x, _by_layer(synapses, *panels.gradients(grad_y))

    return ys, gradients


def _input_gradient(x: Spikes, grad_y: Tensor, synapses: Synapses, is_asked: bool) -> Tensor | None:
    """Of fully connected layers, with channels innermost."""
    if not is_asked:
        return None
    grad_IK, places = matrix_product(grad_y, synapses.weight), x.memory.shape[2:-1]
    if not places:
        return grad_IK
    grad_IPC = torch.empty(len(grad_IK), *places, x.channels, dtype=grad_IK.dtype)
    sizes = (len(grad_IK), x.channels, math.prod(places), torch.get_num_threads())
    library().snn_channels_last(*typed(grad_IK), grad_IPC.data_ptr(), *sizes)
    return grad_IPC


def _by_layer(synapses: Synapses, grad_weight: Tensor, grad_bias: Tensor) -> list[Tensor]:
    """Gradients in the order of the parameters."""
    sizes = [bias.shape[0] for bias in synapses.parameters[1::2]]
    pairs = zip(grad_weight.split(sizes), grad_bias.split(sizes), strict=True)
    return [gradient for pair in pairs for gradient in pair]


def _flat(numbers: Tensor) -> Tensor:
    return numbers.flatten(0, 1).movedim(-1, 1).flatten(1)


def _words(bits: Tensor) -> int:
    """Where they lie; ValueError for what C++ would read wrongly."""
    if bits.dtype != torch.int32 or not bits.is_cpu or not bits.is_contiguous():
        raise ValueError(f"{bits.dtype} with strides {bits.stride()} on {bits.device}, expected contiguous int32 words")
    return bits.data_ptr()
