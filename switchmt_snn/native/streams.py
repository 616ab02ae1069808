"""Gains of the active dendrites, and heads, in C++ (``csrc/streams.cpp``).

They are few multiplications, but PyTorch takes some fifty single operations for them.

Shapes: S steps of the spikes (T, or 1 for their mean), B batch, N neurons of all streams, A actions, M quantiles,
O outputs: one per quantile and action, the actions of a quantile side by side.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor

from switchmt_snn.native.library import library
from switchmt_snn.native.pointers import FLOAT32, pointer
from switchmt_snn.spiking.network import QNetwork, Stream


class _Dendrites(NamedTuple):
    segments_NSK: Tensor
    by_size: bool
    """Whether the response that is largest in absolute value wins."""
    first: int
    """Index of the stream's first neuron among those of all streams."""
    neurons: int

    def arguments(self, task: int) -> tuple[int, ...]:
        """Arguments of the C++ call: pointer, shape, task and gating rule. Raises IndexError for an unknown task."""
        tasks = self.segments_NSK.shape[2]
        if not 0 <= task < tasks:
            raise IndexError(f"task {task}, expected 0 to {tasks - 1}")
        return pointer(self.segments_NSK, FLOAT32), *self.segments_NSK.shape, task, self.by_size


class Gains:
    """Gains of the dendrites of all streams.

    Attributes:
        parameters: the segments of those that have dendrites.
    """

    def __init__(self, streams: Sequence[Stream]) -> None:
        self._neurons, self._dendrites = 0, []
        for stream in streams:
            neurons = stream.synapses.out_features
            if (dendrites := stream.dendrites) is not None:
                by_size = dendrites.gating != "max"
                self._dendrites.append(_Dendrites(dendrites.segments_NSK, by_size, self._neurons, neurons))
            self._neurons += neurons
        self.parameters = tuple(part.segments_NSK for part in self._dendrites)

    def of_task(self, task: int) -> Tensor:
        """``[N]``, one stream after the other.

        Raises:
            IndexError: unknown task.
        """
        gain_N = torch.ones(self._neurons)
        for part in self._dendrites:
            library().snn_gains(*part.arguments(task), gain_N.data_ptr() + part.first * 4, part.neurons)
        return gain_N

    def gradients(self, task: int, grad_gain_N: Tensor) -> list[Tensor]:
        """Gradients of ``parameters``, from that of ``of_task``.

        Raises:
            IndexError: unknown task.
            ValueError: the gradient is not contiguous float32 of all neurons.
        """
        gradients, first = [], pointer(grad_gain_N, FLOAT32, (self._neurons,))
        for part in self._dendrites:
            gradient = torch.empty_like(part.segments_NSK)
            pointers = first + part.first * 4, gradient.data_ptr()
            library().snn_gains_backward(*part.arguments(task), *pointers, part.neurons)
            gradients.append(gradient)
        return gradients


class _Head(ctypes.Structure):
    """``struct Head`` of ``csrc/streams.cpp``."""

    _fields_ = (
        ("weight", ctypes.c_void_p),
        ("bias", ctypes.c_void_p),
        ("combination", ctypes.c_void_p),
        ("grad_weight", ctypes.c_void_p),
        ("grad_bias", ctypes.c_void_p),
        ("inputs", ctypes.c_long),
        ("outputs", ctypes.c_long),
    )


class Heads:
    """The heads of all streams and the combination of their outputs, which is linear, as one matrix.

    With quantiles, there is a second one of their means.

    Attributes:
        parameters: weight and bias of each head.
    """

    def __init__(self, network: QNetwork) -> None:
        """Reads no parameter yet; see ``read``."""
        layers = {name: cast(Stream, stream).head for name, stream in network.streams.items()}
        self.parameters = tuple(part for layer in layers.values() for part in (layer.weight, layer.bias))
        self._quantiles = network.config.quantiles
        outputs = [layer.out_features // self._quantiles for layer in layers.values()]
        units = torch.eye(sum(outputs)).split(outputs, dim=-1)
        combination = network.combine(dict(zip(layers, units, strict=True))).contiguous()
        self._combinations = combination.split(outputs)  # what a head's outputs of a quantile add to Q, [outputs, A]
        neurons, actions = sum(layer.in_features for layer in layers.values()), combination.shape[1]
        self._weight_ON = torch.empty(self._quantiles * actions, neurons)
        self._bias_O = torch.empty(self._quantiles * actions)
        self._mean = self._weight_ON, self._bias_O
        self._heads = (_Head * len(layers))()
        for head, layer, combination in zip(self._heads, layers.values(), self._combinations, strict=True):
            head.combination = combination.data_ptr()
            head.inputs, head.outputs = layer.in_features, len(combination)

    def read(self) -> None:
        """Make the matrix from the parameters as they are now.

        Raises:
            ValueError: they are not contiguous float32.
        """
        outputs, neurons = self._weight_ON.shape
        quantiles, actions = self._quantiles, outputs // self._quantiles
        for head, weight, bias in zip(self._heads, self.parameters[::2], self.parameters[1::2], strict=True):
            head.weight = pointer(weight, FLOAT32, (quantiles * head.outputs, head.inputs))
            head.bias = pointer(bias, FLOAT32, (quantiles * head.outputs,))
        heads = ctypes.addressof(self._heads), len(self._heads)
        combined = self._weight_ON.data_ptr(), self._bias_O.data_ptr()
        library().snn_combine_heads(*heads, *combined, neurons, quantiles, actions)
        if quantiles > 1:
            shape = quantiles, actions
            self._mean = self._weight_ON.unflatten(0, shape).mean(0), self._bias_O.unflatten(0, shape).mean(0)

    def outputs(self, spikes_SBN: Tensor) -> Tensor:
        """``[S, B, O]`` for float32 spikes: values of all quantiles, if the heads are all that follows.

        Raises:
            ValueError: spikes are not contiguous float32 of all neurons.
        """
        return _read_out(spikes_SBN, self._weight_ON, self._bias_O)

    def means(self, spikes_SBN: Tensor) -> Tensor:
        """``[S, B, A]``: as ``outputs``, the means over the quantiles.

        Raises:
            ValueError: spikes are not contiguous float32 of all neurons.
        """
        return _read_out(spikes_SBN, *self._mean)

    def gradients(self, spikes_SBN: Tensor, grad_SBO: Tensor, scale: float) -> tuple[Tensor, list[Tensor]]:
        """Gradients of the spikes, times a scale, and of ``parameters``, from that of ``outputs``.

        Raises:
            ValueError: spikes or gradient are not contiguous float32 of all neurons or outputs.
        """
        (outputs, neurons), rows = self._weight_ON.shape, spikes_SBN.shape[0] * spikes_SBN.shape[1]
        grad_spikes, gradients = torch.empty_like(spikes_SBN), [torch.empty_like(part) for part in self.parameters]
        for head, weight, bias in zip(self._heads, gradients[::2], gradients[1::2], strict=True):
            head.grad_weight, head.grad_bias = weight.data_ptr(), bias.data_ptr()
        spikes = pointer(spikes_SBN, FLOAT32, (None, None, neurons))
        grad = pointer(grad_SBO, FLOAT32, (*spikes_SBN.shape[:2], outputs))
        sizes = (rows, neurons, self._quantiles, outputs // self._quantiles, torch.get_num_threads())
        heads = ctypes.addressof(self._heads), len(self._heads)
        pointers = self._weight_ON.data_ptr(), spikes, grad
        library().snn_heads_backward(*heads, *pointers, scale, grad_spikes.data_ptr(), *sizes)
        return grad_spikes, gradients


def _read_out(spikes_SBN: Tensor, weight_ON: Tensor, bias_O: Tensor) -> Tensor:
    """``[S, B, O]``: the spikes times a matrix, and a bias."""
    (steps, batch, _), (outputs, neurons) = spikes_SBN.shape, weight_ON.shape
    values_SBO = torch.empty(steps, batch, outputs)
    spikes = pointer(spikes_SBN, FLOAT32, (None, None, neurons))
    pointers = spikes, weight_ON.data_ptr(), bias_O.data_ptr(), values_SBO.data_ptr()
    library().snn_read_out(*pointers, steps * batch, neurons, outputs, torch.get_num_threads())
    return values_SBO
