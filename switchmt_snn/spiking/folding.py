"""Folding: a Q-network as one chain of synapses and neurons. It knows no agent, no suite and no run.

BatchNorm (with a task's running statistics) and the dendritic gain of a task are affine maps of a layer's output
channels, so a layer of task k is ``current = scale[k] * (W x) + shift[k]``, computed in float64. The two streams of a
dueling network become one linear layer, channel after channel, and its head becomes ``[value | advantage minus its
mean over actions]``: one plain chain with the same values. ``switchmt_snn.spiking.folding_heads`` folds the heads.

Every module is recognized by its exact type. An unknown one is refused by name and never left out.

Shapes: O output channels or features, K tasks, A actions, N neurons of a layer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from switchmt_snn.config import METHOD_TRAITS, NetworkConfig
from switchmt_snn.errors import ExportError, TaskError, did_you_mean
from switchmt_snn.spiking.dendrites import ActiveDendrites
from switchmt_snn.spiking.encodings import encoding_class
from switchmt_snn.spiking.folding_heads import head_node, joined_heads
from switchmt_snn.spiking.heads import TaskHeads
from switchmt_snn.spiking.layers import (
    Array,
    Conv,
    Dense,
    Layer,
    NeuronNode,
    Pair,
    ReadoutNode,
    SynapseNode,
    TaskDense,
    convolved_sides,
    side_by_side,
)
from switchmt_snn.spiking.network import Convolution, ObservationSpec, QNetwork, Stream, TrunkLayer
from switchmt_snn.spiking.neurons import NeuronLayer
from switchmt_snn.spiking.normalization import FixedBatchNorm, TaskBatchNorm


@dataclass(frozen=True)
class StreamNodes:
    """One stream: a hidden layer and its own head."""

    hidden: Layer
    head: Dense | TaskDense


@dataclass(frozen=True)
class NetworkNodes:
    """A Q-network as it is built: the trunk's layers one after the other, then the streams in parallel."""

    trunk: tuple[Layer, ...]
    streams: dict[str, StreamNodes]


@dataclass(frozen=True)
class FoldedNetwork:
    """A Q-network for all its tasks as one chain.

    Attributes:
        layers: synapses with their neurons, in forward order.
        head: the last synapses, which feed the readout.
        readout: Q-values from the head's outputs.
        settings: the resolved settings that the network was built with.
        observation: what the input looks like.
        observation_dtype: of raw observations, uint8 or float32.
        tasks: names; a task's index counts in this order.
        actions: names.
        valid_actions_KA: which actions exist in which task.
        step: training step of the weights.
        first_actions: by task, what its environment adds to an action's index; empty means 0.
    """

    layers: tuple[Layer, ...]
    head: SynapseNode
    readout: ReadoutNode
    settings: NetworkConfig
    observation: ObservationSpec
    observation_dtype: npt.DTypeLike
    tasks: tuple[str, ...]
    actions: tuple[str, ...]
    valid_actions_KA: npt.NDArray[np.bool_]
    step: int
    first_actions: tuple[int, ...] = ()

    @property
    def synapses(self) -> tuple[SynapseNode, ...]:
        """Those of all layers in forward order, the head last."""
        return (*(layer.synapses for layer in self.layers), self.head)

    @property
    def spiking(self) -> bool:
        """Whether the neurons spike."""
        return METHOD_TRAITS[self.settings.method].spiking

    @property
    def sees_spikes(self) -> bool:
        """Whether the first layer's inputs are spikes."""
        return encoding_class(self.settings.encoding).makes_spikes

    @property
    def constant_input(self) -> bool:
        """Whether the first layer has the same input at every simulation step, so that it is computed once."""
        return encoding_class(self.settings.encoding).constant_over_time

    @property
    def encoded_shape(self) -> tuple[int, ...]:
        """Shape of the input at one simulation step, after encoding."""
        return self.synapses[0].input_shape

    def task_index(self, task: str) -> int:
        """Index of a task by name.

        Raises:
            TaskError: unknown task.
        """
        if task not in self.tasks:
            raise TaskError(f"unknown task {task!r}{did_you_mean(task, self.tasks)}")
        return self.tasks.index(task)

    def with_synapses(self, change: Callable[[SynapseNode], SynapseNode]) -> FoldedNetwork:
        """The same network with changed synapses, the head's too."""
        layers = tuple(replace(layer, synapses=change(layer.synapses)) for layer in self.layers)
        return replace(self, layers=layers, head=change(self.head))

    def of_task(self, task: int) -> FoldedNetwork:
        """The same network without the weights that only other tasks use."""
        return self.with_synapses(lambda node: node.of_task(task))


def fold(
    network: QNetwork,
    tasks: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
    valid_actions_KA: npt.NDArray[np.bool_] | None = None,
    observation_dtype: npt.DTypeLike | None = None,
    step: int = 0,
    first_actions: Sequence[int] = (),
) -> FoldedNetwork:
    """Fold a network for all its tasks.

    Args:
        network: a Q-network; only its eval mode is described.
        tasks: names; None numbers them (``task_0``, ...).
        actions: names; None numbers them (``action_0``, ...).
        valid_actions_KA: which actions exist in which task; None means all.
        observation_dtype: of raw observations; None means uint8 for a range of [0, 1], else float32.
        step: training step of the weights.
        first_actions: by task, what its environment adds to an action's index; empty means 0.

    Raises:
        ExportError: a weight is not finite, or a module has no node.
    """
    for name, tensor in network.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise ExportError(f"{name} holds values that are not finite, expected numbers; export another checkpoint")
    seen = network.observation
    nodes = network_nodes(network)
    hidden, head = _joined(nodes.streams)
    if observation_dtype is None:
        observation_dtype = np.uint8 if seen.in_unit_range else np.float32
    return FoldedNetwork(
        layers=(*nodes.trunk, hidden),
        head=head,
        readout=ReadoutNode(network.config.readout, network.config.readout_beta),
        settings=network.config,
        observation=seen,
        observation_dtype=observation_dtype,
        tasks=tuple(tasks or (f"task_{k}" for k in range(seen.num_tasks))),
        actions=tuple(actions or (f"action_{a}" for a in range(seen.num_actions))),
        valid_actions_KA=np.ones((seen.num_tasks, seen.num_actions), np.bool_)
        if valid_actions_KA is None
        else valid_actions_KA,
        step=step,
        first_actions=tuple(first_actions),
    )


def network_nodes(network: QNetwork) -> NetworkNodes:
    """The nodes of a network, its streams apart.

    Raises:
        ExportError: a module has no node.
    """
    tasks, shape = range(network.observation.num_tasks), network.observation.shape
    shape = (network.encoder.channels(shape[0], network.observation.frame_stack), *shape[1:])
    trunk: list[Layer] = []
    for name, layer in network.trunk.items():
        trunk.append(_trunk_layer(name, layer, shape, tasks))
        shape = trunk[-1].output_shape
    features, quantiles = (math.prod(shape),), network.config.quantiles
    streams = {name: _stream(name, stream, features, quantiles, tasks) for name, stream in network.streams.items()}
    return NetworkNodes(tuple(trunk), streams)


def quantized(network: FoldedNetwork, bits: int = 8) -> FoldedNetwork:
    """Weights as integers of ``bits`` bits times one step per output channel (symmetric, no zero point).

    BatchNorm and gains scale whole output channels, so every task shares the integers. Shifts stay float32.
    """
    largest = 2 ** (bits - 1) - 1

    def rounded(node: SynapseNode) -> SynapseNode:
        peak_O = np.abs(node.weight).reshape(len(node.weight), -1).max(axis=1)
        steps_O = np.where(peak_O > 0, peak_O / largest, 1.0).astype(np.float32).astype(np.float64)
        integers = np.clip(np.rint(node.weight / node.over_weight(steps_O)), -largest, largest)
        return replace(node, weight=integers * node.over_weight(steps_O), weight_steps_O=steps_O)

    return network.with_synapses(rounded)


def _float64(tensor: Tensor) -> Array:
    return cast(Array, tensor.detach().cpu().to(torch.float64).numpy())


def _require(module: nn.Module, kind: type[nn.Module], name: str) -> None:
    """Refuse a module that is not exactly of a type: a subclass may compute something else."""
    if type(module) is not kind:
        raise ExportError(
            f"{name} is a {type(module).__name__}, expected a {kind.__name__}; add a node to spiking/layers.py and a "
            "rule to spiking/folding.py"
        )


def _conv(name: str, module: nn.Module, input_shape: tuple[int, ...], tasks: range) -> Conv:
    convolution = cast(nn.Conv2d, module)
    for setting, expected in (("groups", 1), ("dilation", (1, 1)), ("padding_mode", "zeros")):
        seen = getattr(convolution, setting)
        if seen != expected:
            raise ExportError(f"the convolution of {name} has {setting} {seen!r}, expected {expected!r}")
    if isinstance(convolution.padding, str):
        raise ExportError(f"the convolution of {name} has padding {convolution.padding!r}, expected numbers")
    weight = _float64(convolution.weight)
    if weight.shape[1] != input_shape[0]:
        raise ExportError(f"{name} has weights for {weight.shape[1]} channels, expected {input_shape[0]}")
    stride, padding = cast(Pair, convolution.stride), cast(Pair, convolution.padding)
    scale_KO, shift_KO = _bias(convolution.bias, len(weight), tasks)
    sides = convolved_sides(input_shape[1:], weight.shape[2:], stride, padding)
    return Conv(
        name=name,
        weight=weight,
        scale_KO=scale_KO,
        shift_KO=shift_KO,
        input_shape=input_shape,
        output_shape=(len(weight), *sides),
        stride=stride,
        padding=padding,
    )


def _dense(name: str, module: nn.Module, input_shape: tuple[int, ...], tasks: range) -> Dense:
    linear = cast(nn.Linear, module)
    weight = _float64(linear.weight)
    if weight.shape[1] != math.prod(input_shape):
        raise ExportError(f"{name} has weights for {weight.shape[1]} inputs, expected {math.prod(input_shape)}")
    scale_KO, shift_KO = _bias(linear.bias, len(weight), tasks)
    return Dense(
        name=name,
        weight=weight,
        scale_KO=scale_KO,
        shift_KO=shift_KO,
        input_shape=input_shape,
        output_shape=(len(weight),),
    )


def _flattened(name: str, module: nn.Module, input_shape: tuple[int, ...], tasks: range) -> Dense:
    """A linear layer that flattens an image first."""
    parts = list(cast(nn.Sequential, module))
    kinds = [type(part) for part in parts]
    flatten = parts[0] if kinds == [nn.Flatten, nn.Linear] else None
    if not isinstance(flatten, nn.Flatten) or flatten.start_dim != 1 or flatten.end_dim != -1:
        seen = ", ".join(map(str, parts))
        raise ExportError(f"the synapses of {name} are a Sequential of {seen}, expected Flatten(1), Linear")
    return _dense(name, parts[1], input_shape, tasks)


_SYNAPSES: dict[type[nn.Module], Callable[[str, nn.Module, tuple[int, ...], range], SynapseNode]] = {
    Convolution: _conv,
    nn.Conv2d: _conv,
    nn.Linear: _dense,
    nn.Sequential: _flattened,
}
"""Rule of each synaptic module, by exact type."""


def _synapses(name: str, module: nn.Module, input_shape: tuple[int, ...], tasks: range) -> SynapseNode:
    rule = _SYNAPSES.get(type(module))
    if rule is None:
        known = ", ".join(kind.__name__ for kind in _SYNAPSES)
        raise ExportError(
            f"the synapses of {name} are a {type(module).__name__}, expected one of {known}; add a node to "
            "spiking/layers.py and a rule to spiking/folding.py"
        )
    return rule(name, module, input_shape, tasks)


def _bias(bias_O: Tensor | None, outputs: int, tasks: range) -> tuple[Array, Array]:
    """Scale 1 and the bias as shift ``[K, O]``."""
    shift_O = np.zeros(outputs) if bias_O is None else _float64(bias_O)
    return np.ones((len(tasks), outputs)), np.tile(shift_O, (len(tasks), 1))


def _neurons(neurons: nn.Module, channels: int, name: str) -> NeuronNode:
    """The neurons' own description; an opaque one where a subclass has changed what it inherits a description of."""
    if not isinstance(neurons, NeuronLayer):
        raise ExportError(f"the neurons of {name} are a {type(neurons).__name__}, expected a NeuronLayer")
    lineage = type(neurons).__mro__
    describes, computes = (
        min(index for index, kind in enumerate(lineage) if names & vars(kind).keys())
        for names in ({"node"}, {"step", "run", "forward", "initial_state"})
    )
    return neurons.node(channels) if describes <= computes else NeuronLayer.node(neurons, channels)


def _trunk_layer(name: str, module: nn.Module, input_shape: tuple[int, ...], tasks: range) -> Layer:
    """BatchNorm of ``y = W x + b`` is ``(y - mean) * weight / sqrt(var + epsilon) + bias``."""
    _require(module, TrunkLayer, name)
    layer = cast(TrunkLayer, module)
    node = _synapses(name, layer.synapses, input_shape, tasks)
    if layer.normalization is not None:
        _require(layer.normalization, TaskBatchNorm, f"the normalization of {name}")
        _normalize(node, layer.normalization, tasks)
    return Layer(node, _neurons(layer.neurons, len(node.weight), name))


def _normalize(node: SynapseNode, norm: TaskBatchNorm, tasks: range) -> None:
    """Fold BatchNorm into a node's scale and shift, in place."""
    for task in tasks:
        mean_O, var_O = (_float64(value) for value in norm.statistics(task))
        node.scale_KO[task] = _float64(norm.weight) / np.sqrt(var_O + norm.epsilon)
        node.shift_KO[task] = (node.shift_KO[task] - mean_O) * node.scale_KO[task] + _float64(norm.bias)


def _stream(name: str, module: nn.Module, features: tuple[int, ...], quantiles: int, tasks: range) -> StreamNodes:
    """A stream's hidden layer, with the gains of its dendrites in scale and shift, and its head."""
    _require(module, Stream, name)
    stream = cast(Stream, module)
    _require(stream.synapses, nn.Linear, f"{name}.synapses")
    per_task = type(stream.head) is TaskHeads
    _require(stream.head, TaskHeads if per_task else nn.Linear, f"{name}.head")
    hidden = _dense(f"{name}.hidden", stream.synapses, features, tasks)
    outputs = len(hidden.weight)
    if stream.normalization is not None:
        _require(stream.normalization, FixedBatchNorm, f"the normalization of {name}")
        _normalize(hidden, stream.normalization, tasks)
    if stream.dendrites is not None:
        _require(stream.dendrites, ActiveDendrites, f"the dendrites of {name}")
        with torch.no_grad():
            gain_KO = np.stack([np.broadcast_to(_float64(stream.dendrites(k)), (outputs,)) for k in tasks])
        hidden = replace(hidden, scale_KO=gain_KO * hidden.scale_KO, shift_KO=gain_KO * hidden.shift_KO, gated=True)
    if stream.k_winners is not None and stream.k_winners < outputs:
        hidden = replace(hidden, k_winners=stream.k_winners)
    neurons = _neurons(stream.neurons, outputs, name)
    rows = _dense(f"{name}.head", stream.head, hidden.output_shape, tasks)
    return StreamNodes(Layer(hidden, neurons), head_node(rows, quantiles, per_task))


def _joined(streams: dict[str, StreamNodes]) -> tuple[Layer, Dense | TaskDense]:
    """The hidden layers of all streams as one, and their heads as one."""
    parts = [cast(Dense, stream.hidden.synapses) for stream in streams.values()]
    first = parts[0]
    if any((part.k_winners, part.gated) != (first.k_winners, first.gated) for part in parts):
        raise ExportError("the streams differ in k_winners or in having dendrites, expected the same in each")
    hidden = Dense(
        name="hidden",
        weight=np.concatenate([part.weight for part in parts]),
        scale_KO=np.concatenate([part.scale_KO for part in parts], axis=1),
        shift_KO=np.concatenate([part.shift_KO for part in parts], axis=1),
        input_shape=first.input_shape,
        output_shape=(sum(part.outputs for part in parts),),
        groups=len(parts),
        k_winners=first.k_winners,
        gated=first.gated,
    )
    neurons = side_by_side([stream.hidden.neurons for stream in streams.values()])
    return Layer(hidden, neurons), joined_heads({name: stream.head for name, stream in streams.items()})
