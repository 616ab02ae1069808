"""What lies around the streams' products, in C++ (``native_streams.cpp``): gains of the active dendrites, and heads.

There is hardly anything to compute, but PyTorch takes some fifty single operations for it.

Shapes: S steps of the spikes (T, or 1 for their mean), B batch, N neurons of all streams, A actions.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from typing import cast

import torch
from torch import Tensor

from switchmt_snn.spiking.native_library import library
from switchmt_snn.spiking.network import QNetwork, Stream


class Gains:
    """Gains of the dendrites of all streams.

    Attributes:
        parameters: the segments of those that have dendrites.
    """

    def __init__(self, streams: Sequence[Stream]) -> None:
        self._sizes = [stream.synapses.out_features for stream in streams]
        self._segments = [None if stream.dendrites is None else stream.dendrites.segments_NSK for stream in streams]
        self._by_size = [stream.dendrites is not None and stream.dendrites.gating != "max" for stream in streams]
        self.parameters = tuple(segments for segments in self._segments if segments is not None)

    def of_task(self, task: int) -> Tensor:
        """``[N]``, one stream after the other."""
        gain_N = torch.ones(sum(self._sizes))
        for segments, place, what, size in self._parts(gain_N, task):
            library().snn_gains(segments.data_ptr(), *what, place, size)
        return gain_N

    def gradients(self, task: int, grad_gain_N: Tensor) -> list[Tensor]:
        """Of :attr:`parameters`, from that of :meth:`of_task`."""
        gradients = []
        for segments, place, what, size in self._parts(grad_gain_N, task):
            gradients.append(torch.empty_like(segments))
            library().snn_gains_gradient(segments.data_ptr(), *what, place, gradients[-1].data_ptr(), size)
        return gradients

    def _parts(self, numbers_N: Tensor, task: int) -> Iterator[tuple[Tensor, int, tuple[int, ...], int]]:
        """Of each stream with dendrites: segments, where its numbers lie, its sizes and rule, its neurons."""
        place = _numbers(numbers_N, sum(self._sizes))
        for segments, size, by_size in zip(self._segments, self._sizes, self._by_size, strict=True):
            if segments is not None:
                yield segments, place, (*segments.shape, task, by_size), size
            place += size * numbers_N.element_size()


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
            head.weight, head.bias = layer.weight.data_ptr(), layer.bias.data_ptr()
            head.combination, head.inputs, head.outputs = (
                combination.data_ptr(),
                layer.in_features,
                layer.out_features,
            )

    def read(self) -> None:
        """Make the matrix that of the parameters as they are now."""
        actions, neurons = self._weight_AN.shape
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
