"""What lies around the streams' products, in C++ (``native_streams.cpp``): gains of the active dendrites, and heads.

There is hardly anything to compute, but PyTorch takes some fifty single operations for it.

Shapes: S steps of the spikes (T, or 1 for their mean), B batch, N neurons of all streams, A actions.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor

from switchmt_snn.native.library import library
from switchmt_snn.spiking.network import QNetwork, Stream


class _Dendrites(NamedTuple):
    segments_NSK: Tensor
    by_size: bool
    """Whether the response that is largest in absolute value wins."""
    first: int
    """Of the stream's neurons among those of all streams."""
    neurons: int

    def what(self, task: int) -> tuple[int, ...]:
        """Where the segments lie, how many there are, and how one wins; IndexError for a task that there is not."""
        tasks = self.segments_NSK.shape[2]
        if not 0 <= task < tasks:
            raise IndexError(f"task {task}, expected 0 to {tasks - 1}")
        return _numbers(self.segments_NSK, tasks), *self.segments_NSK.shape, task, self.by_size


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
            IndexError: there is no such task.
        """
        gain_N = torch.ones(self._neurons)
        for part in self._dendrites:
            library().snn_gains(*part.what(task), gain_N.data_ptr() + part.first * 4, part.neurons)
        return gain_N

    def gradients(self, task: int, grad_gain_N: Tensor) -> list[Tensor]:
        """Of :attr:`parameters`, from that of :meth:`of_task`.

        Raises:
            IndexError: there is no such task.
            ValueError: the gradient is not contiguous float32 of all neurons.
        """
        gradients, place = [], _numbers(grad_gain_N, self._neurons)
        for part in self._dendrites:
            gradient = torch.empty_like(part.segments_NSK)
            places = place + part.first * 4, gradient.data_ptr()
            library().snn_gains_gradient(*part.what(task), *places, part.neurons)
            gradients.append(gradient)
        return gradients


class _Head(ctypes.Structure):
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

    Attributes:
        parameters: weight and bias of each head.
    """

    def __init__(self, network: QNetwork) -> None:
        """Nothing is read yet; see :meth:`read`."""
        layers = {name: cast(Stream, stream).head for name, stream in network.streams.items()}
        self.parameters = tuple(part for layer in layers.values() for part in (layer.weight, layer.bias))
        outputs = [layer.out_features for layer in layers.values()]
        units = torch.eye(sum(outputs)).split(outputs, dim=-1)
        combination_OA = network.combine(dict(zip(layers, units, strict=True))).contiguous()
        self._combinations = combination_OA.split(outputs)  # what a head's outputs add to Q
        neurons, actions = sum(layer.in_features for layer in layers.values()), combination_OA.shape[1]
        self._weight_AN, self._bias_A = torch.empty(actions, neurons), torch.empty(actions)
        self._heads = (_Head * len(layers))()
        for head, layer, combination in zip(self._heads, layers.values(), self._combinations, strict=True):
            head.combination = combination.data_ptr()
            head.inputs, head.outputs = layer.in_features, layer.out_features

    def read(self) -> None:
        """Make the matrix that of the parameters as they are now.

        Raises:
            ValueError: they are not contiguous float32.
        """
        actions, neurons = self._weight_AN.shape
        for head, weight, bias in zip(self._heads, self.parameters[::2], self.parameters[1::2], strict=True):
            head.weight, head.bias = _numbers(weight, head.inputs), _numbers(bias, head.outputs)
        places = self._weight_AN.data_ptr(), self._bias_A.data_ptr()
        library().snn_heads(ctypes.addressof(self._heads), len(self._heads), *places, neurons, actions)

    def outputs(self, spikes_SBN: Tensor) -> Tensor:
        """``[S, B, A]`` for float32 spikes: Q-values, if the heads are all that follows.

        Raises:
            ValueError: spikes are not contiguous float32 of all neurons.
        """
        steps, batch, _ = spikes_SBN.shape
        actions, neurons = self._weight_AN.shape
        q_SBA = torch.empty(steps, batch, actions)
        places = _numbers(spikes_SBN, neurons), self._weight_AN.data_ptr(), self._bias_A.data_ptr(), q_SBA.data_ptr()
        library().snn_read_out(*places, steps * batch, neurons, actions, torch.get_num_threads())
        return q_SBA

    def gradients(self, spikes_SBN: Tensor, grad_SBA: Tensor, scale: float) -> tuple[Tensor, list[Tensor]]:
        """Of the spikes, times a scale, and of :attr:`parameters`.

        Raises:
            ValueError: spikes or gradient are not contiguous float32 of all neurons or actions.
        """
        (actions, neurons), rows = self._weight_AN.shape, spikes_SBN.shape[0] * spikes_SBN.shape[1]
        grad_spikes, gradients = torch.empty_like(spikes_SBN), [torch.empty_like(part) for part in self.parameters]
        for head, weight, bias in zip(self._heads, gradients[::2], gradients[1::2], strict=True):
            head.grad_weight, head.grad_bias = weight.data_ptr(), bias.data_ptr()
        numbers = self._weight_AN.data_ptr(), _numbers(spikes_SBN, neurons), _numbers(grad_SBA, actions)
        sizes = (rows, neurons, actions, torch.get_num_threads())
        heads = ctypes.addressof(self._heads), len(self._heads)
        library().snn_heads_gradient(*heads, *numbers, scale, grad_spikes.data_ptr(), *sizes)
        return grad_spikes, gradients


def _numbers(x: Tensor, last: int) -> int:
    """Where they lie; ValueError for what C++ would read wrongly."""
    if x.dtype != torch.float32 or not x.is_cpu or not x.is_contiguous() or x.shape[-1] != last:
        raise ValueError(f"{x.dtype} {tuple(x.shape)} on {x.device}, expected contiguous float32 [..., {last}]")
    return x.data_ptr()
