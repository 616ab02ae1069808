"""Synaptic products with their gradients: of spikes that are kept as bits (``panels``), or of
dense values (``dense``).

Products of bits are float32 sums of weights, at some three times the speed of float32 multiplications.

Shapes: T steps, B batch, I = T * B images, H, W sides, C channels in, O channels out, K inputs of an output.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import cast

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
from switchmt_snn.native.library import library
from switchmt_snn.native.neurons import Spikes
from switchmt_snn.native.panels import LANES, Panels
from switchmt_snn.native.pointers import typed_pointer

Gradients = Callable[[Tensor, bool], tuple[Tensor | None, list[Tensor]]]
"""The backward of some products, from their gradient (``[I, ..., O]``, contiguous, in their dtype).

It returns the gradient of the inputs, if asked for, dense ``[I, ..., C]`` in the memory order of the inputs; and those
of ``Synapses.parameters``, float32.
"""


class Synapses:
    """Synapses of a convolution, or of fully connected layers with the same inputs, one after the other.

    Attributes:
        parameters: weight and bias of each layer.
        weight: copies of all weights in the products' dtype, a convolution's with channels innermost.
        bias: all biases.
        stride: a convolution's.
        copies: the parts of ``weight`` and ``bias`` that are copies, by parameter.
    """

    def __init__(self, layers: Sequence[nn.Linear | nn.Conv2d], dtype: torch.dtype) -> None:
        """Nothing is read yet; see ``read``."""
        weights, biases = [layer.weight for layer in layers], [cast(Tensor, layer.bias) for layer in layers]
        self.parameters = tuple(part for layer in zip(weights, biases, strict=True) for part in layer)
        sizes = [len(weight) for weight in weights]
        outputs, (channels, *kernel) = sum(sizes), weights[0].shape[1:]
        self._weight_memory = torch.empty(outputs, *kernel, channels, dtype=dtype)
        self._missing = -channels % 32 if kernel else 0
        self._flat = self._weight_memory.flatten(1)
        self.weight = self._weight_memory.movedim(-1, 1)
        self.stride = layers[0].stride[0] if isinstance(layers[0], nn.Conv2d) else 0
        self.copies = dict(zip(weights, self.weight.split(sizes), strict=True))
        self.bias = biases[0].detach()
        if len(layers) > 1:
            self.bias = torch.empty(outputs)
            self.copies |= dict(zip(biases, self.bias.split(sizes), strict=True))

    def read(self) -> Synapses:
        """Copy the parameters as they are now."""
        with torch.no_grad():
            for part, copy in self.copies.items():
                copy.copy_(part)
        return self

    @property
    def matrix(self) -> Tensor:
        """The weights ``[O, bits]`` for products of bits; a convolution's are padded to whole words of channels."""
        return F.pad(self._weight_memory, (0, self._missing)).flatten(1) if self._missing else self._flat


def convolved(x: Spikes, synapses: Synapses) -> tuple[Tensor, Gradients]:
    """A convolution's products ``[T, B, h, w, O]``, contiguous, for ``[T, B, H, W, C]``."""
    steps, batch, *sides, _ = x.values.shape
    weight, stride = synapses.weight, synapses.stride
    outputs, _, kernel, _ = weight.shape
    out_sides = [out_side(side, kernel, stride) for side in sides]
    images = x.values.flatten(0, 1)
    if x.is_bits:
        panels = Panels.of_windows(images, kernel, stride)
        y = panels.times(synapses.matrix, synapses.bias)
    else:
        dense_ICHW = images.permute(0, 3, 1, 2)
        y = convolution(dense_ICHW, weight, synapses.bias, stride).permute(0, 2, 3, 1)

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        # Two gradients are computed one by one: together, oneDNN takes up to 1.4 times as long.
        grad_x, grad_IOhw = None, grad_y.view(-1, *out_sides, outputs).permute(0, 3, 1, 2)
        if of_inputs:
            grad_ICHW = convolution_input_gradient(grad_IOhw, weight, stride, sides)
            grad_x = channels_last(grad_ICHW).permute(0, 2, 3, 1)
        if not x.is_bits:
            return grad_x, [*convolution_weight_gradient(dense_ICHW, grad_IOhw, weight, stride)]
        grad_matrix, grad_bias = panels.gradients(grad_y.view(-1, outputs))
        grad_OkkC = grad_matrix.view(outputs, kernel, kernel, -1)[..., : x.channels]
        return grad_x, [grad_OkkC.permute(0, 3, 1, 2), grad_bias]

    return y.view(steps, batch, *out_sides, outputs), gradients


def connected(xs: Sequence[Spikes], synapses: Synapses) -> tuple[list[Tensor], Gradients]:
    """Products ``[T, B, O]`` of fully connected layers for each of some inputs ``[T, B, K]``, or images
    ``[T, B, H, W, C]`` that are flattened in the order ``[C, H, W]``. Gradients are those of the first one."""
    if xs[0].is_bits:
        return _connected_bits(xs, synapses)
    flats = [_flat(x.values) for x in xs]
    ys = [F.linear(flat, synapses.weight, synapses.bias.to(flat.dtype)) for flat in flats]
    first, flat, shape = xs[0], flats[0], ys[0].shape

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        grad_y = grad_y.view(shape)
        weight, bias = (grad_y.T @ flat).to(torch.float32), grad_y.sum(0, dtype=torch.float32)
        return _input_gradient(first, grad_y, synapses, of_inputs), _by_layer(synapses, weight, bias)

    return [y.view(*x.values.shape[:2], -1) for x, y in zip(xs, ys, strict=True)], gradients


def _connected_bits(xs: Sequence[Spikes], synapses: Synapses) -> tuple[list[Tensor], Gradients]:
    """All inputs' panels are in one memory, so C++ multiplies them with the same tables."""
    images = [x.values.flatten(0, 1) for x in xs]
    counts = [-(-len(part) // LANES) for part in images]
    joint = Panels.empty(sum(counts) * LANES, synapses.matrix.shape[1])
    parts = [
        Panels.of_images(part, x.channels, words)
        for part, x, words in zip(images, xs, joint.words.split(counts), strict=True)
    ]
    ys_of_parts = joint.times(synapses.matrix, synapses.bias).split([count * LANES for count in counts])
    ys = [y[: part.lanes].view(*x.values.shape[:2], -1) for y, part, x in zip(ys_of_parts, parts, xs, strict=True)]

    first, panels = xs[0], parts[0]

    def gradients(grad_y: Tensor, of_inputs: bool) -> tuple[Tensor | None, list[Tensor]]:
        grad_y = grad_y.view(panels.lanes, -1)
        grad_x = _input_gradient(first, grad_y, synapses, of_inputs)
        return grad_x, _by_layer(synapses, *panels.gradients(grad_y))

    return ys, gradients


def _input_gradient(x: Spikes, grad_y: Tensor, synapses: Synapses, is_asked: bool) -> Tensor | None:
    """Gradient of the inputs of fully connected layers, with channels innermost."""
    if not is_asked:
        return None
    grad_IK, sides = matrix_product(grad_y, synapses.weight), x.values.shape[2:-1]
    if not sides:
        return grad_IK
    grad_IPC = torch.empty(len(grad_IK), *sides, x.channels, dtype=grad_IK.dtype)
    sizes = (len(grad_IK), x.channels, math.prod(sides), torch.get_num_threads())
    library().snn_channels_last(*typed_pointer(grad_IK), grad_IPC.data_ptr(), *sizes)
    return grad_IPC


def _by_layer(synapses: Synapses, grad_weight: Tensor, grad_bias: Tensor) -> list[Tensor]:
    """Gradients in the order of the parameters."""
    sizes = [bias.shape[0] for bias in synapses.parameters[1::2]]
    pairs = zip(grad_weight.split(sizes), grad_bias.split(sizes), strict=True)
    return [gradient for pair in pairs for gradient in pair]


def _flat(dense: Tensor) -> Tensor:
    return dense.flatten(0, 1).movedim(-1, 1).flatten(1)
