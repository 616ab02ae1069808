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


class HeadMatrix(NamedTuple):
    """All heads of a task and the combination of their outputs, which is linear, as one matrix."""

    task: int
    weight_ON: Tensor
    bias_O: Tensor
    mean_weight_AN: Tensor
    """Mean over quantiles; without quantiles ``weight_ON`` itself."""
    mean_bias_A: Tensor

    def outputs(self, spikes_SBN: Tensor) -> Tensor:
        """``[S, B, O]`` for float32 spikes: values of all quantiles, if the heads are all that follows.

        Raises:
            ValueError: spikes are not contiguous float32 of all neurons.
        """
        return _read_out(spikes_SBN, self.weight_ON, self.bias_O)

    def means(self, spikes_SBN: Tensor) -> Tensor:
        """``[S, B, A]``: as ``outputs``, the means over the quantiles.

        Raises:
            ValueError: spikes are not contiguous float32 of all neurons.
        """
        return _read_out(spikes_SBN, self.mean_weight_AN, self.mean_bias_A)


class Heads:
    """The heads of all streams.

    Attributes:
        parameters: weight and bias of each head.
    """

    def __init__(self, network: QNetwork) -> None:
        """Reads no parameter yet; see ``of_task``."""
        config, self._actions = network.config, network.observation.num_actions
        layers = {name: cast(Stream, stream).head for name, stream in network.streams.items()}
        self.parameters = tuple(part for layer in layers.values() for part in (layer.weight, layer.bias))
        self._quantiles = config.quantiles
        self._sets = network.observation.num_tasks if config.heads == "per_task" else 1
        outputs = [layer.out_features // (self._quantiles * self._sets) for layer in layers.values()]
        units = torch.eye(sum(outputs)).split(outputs, dim=-1)
        combination = network.combine(dict(zip(layers, units, strict=True))).contiguous()
        self._combinations = combination.split(outputs)  # what a head's outputs of a quantile add to Q, [outputs, A]
        self._neurons = sum(layer.in_features for layer in layers.values())
        self._heads = (_Head * len(layers))()
        for head, layer, combination in zip(self._heads, layers.values(), self._combinations, strict=True):
            head.combination = combination.data_ptr()
            head.inputs, head.outputs = layer.in_features, len(combination)

    def of_task(self, task: int) -> HeadMatrix:
        """The matrix of a task, from the parameters as they are now.

        Raises:
            IndexError: unknown task.
            ValueError: parameters are not contiguous float32.
        """
        quantiles, actions = self._quantiles, self._actions
        for head, weight, bias in zip(self._heads, self.parameters[::2], self.parameters[1::2], strict=True):
            rows = self._sets * quantiles * head.outputs
            head.weight = pointer(weight, FLOAT32, (rows, head.inputs)) + self._offset(task, head) * head.inputs
            head.bias = pointer(bias, FLOAT32, (rows,)) + self._offset(task, head)
        weight_ON, bias_O = torch.empty(quantiles * actions, self._neurons), torch.empty(quantiles * actions)
        heads = ctypes.addressof(self._heads), len(self._heads)
        library().snn_combine_heads(*heads, weight_ON.data_ptr(), bias_O.data_ptr(), self._neurons, quantiles, actions)
        means = (part if quantiles == 1 else part.unflatten(0, (quantiles, -1)).mean(0) for part in (weight_ON, bias_O))
        return HeadMatrix(task, weight_ON, bias_O, *means)

    def _offset(self, task: int, head: _Head) -> int:
        """Bytes from the first bias of a head to that of a task."""
        if self._sets == 1:
            return 0
        if not 0 <= task < self._sets:
            raise IndexError(f"task {task}, expected 0 to {self._sets - 1}")
        return task * self._quantiles * int(head.outputs) * 4

    def gradients(
        self, spikes_SBN: Tensor, grad_SBO: Tensor, scale: float, matrix: HeadMatrix
    ) -> tuple[Tensor, list[Tensor]]:
        """Gradients of the spikes, times a scale, and of ``parameters``, from that of ``outputs``.

        Raises:
            ValueError: spikes or gradient are not contiguous float32 of all neurons or outputs.
        """
        rows, outputs = spikes_SBN.shape[0] * spikes_SBN.shape[1], len(matrix.bias_O)
        make = torch.empty_like if self._sets == 1 else torch.zeros_like  # other tasks' rows have no gradient
        grad_spikes, gradients = torch.empty_like(spikes_SBN), [make(part) for part in self.parameters]
        for head, weight, bias in zip(self._heads, gradients[::2], gradients[1::2], strict=True):
            offset = self._offset(matrix.task, head)
            head.grad_weight, head.grad_bias = weight.data_ptr() + offset * head.inputs, bias.data_ptr() + offset
        spikes = pointer(spikes_SBN, FLOAT32, (None, None, self._neurons))
        grad = pointer(grad_SBO, FLOAT32, (*spikes_SBN.shape[:2], outputs))
        sizes = (rows, self._neurons, self._quantiles, self._actions, torch.get_num_threads())
        heads = ctypes.addressof(self._heads), len(self._heads)
        pointers = matrix.weight_ON.data_ptr(), spikes, grad
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
