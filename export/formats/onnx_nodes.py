"""The layers of a network as ONNX operators: ``export_synapses`` and ``export_neurons``, one rule per node type.

A node without a rule is refused by name. A neuron from outside the package registers its own rule with
``export_neurons.register`` (docs/extending.md, Neuron).

Shapes: B batch, O outputs of a layer, K tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.export.formats.onnx_graph import FLOAT, TASK, Graph
from switchmt_snn.spiking.layers import Array, Conv, Dense, Layer, NeuronNode, SynapseNode, TaskDense, no_rule
from switchmt_snn.spiking.neurons import AdaptiveNode, LeakyNode, ReLUNode, SynapticNode

_REMEDY = "add a rule to export/formats/onnx_nodes.py"
_NEURON_REMEDY = "a neuron of your own needs a node() and an ONNX rule: docs/extending.md, Neuron"


@dataclass(frozen=True)
class Weights:
    """Names of a layer's constants in a graph; scale and shift only where one file serves several tasks."""

    weight: str
    bias: str | None
    scale: str | None
    shift: str | None


def weights_of(graph: Graph, node: SynapseNode, task: int | None) -> Weights:
    """Define a layer's constants: of one task folded in, or shared weights with scale and shift picked by ``task``."""
    name = node.name
    if task is not None or not node.depends_on_task:
        weight, bias = node.folded(task or 0)
        return Weights(_weight(graph, node, weight, task or 0), graph.constant(f"{name}_bias", bias), None, None)
    terms = []
    for kind, rows in (("scale", node.scale_KO), ("shift", node.shift_KO)):
        table = graph.constant(f"{name}_{kind}_by_task", rows)
        row = graph.add("Gather", [table, TASK], f"{name}_{kind}_row", axis=0)
        if len(node.output_shape) == 3:
            axes = graph.constant("image_axes", [2, 3], np.int64)
            row = graph.add("Unsqueeze", [row, axes], f"{name}_{kind}")
        terms.append(row)
    return Weights(_weight(graph, node, node.weight, None), None, terms[0], terms[1])


def _weight(graph: Graph, node: SynapseNode, weight: npt.NDArray[Any], task: int | None) -> str:
    name = f"{node.name}_weight"
    if node.weight_steps_O is None:
        return graph.constant(name, weight)
    integers = np.rint(node.weight / node.over_weight(node.weight_steps_O))
    scale_O = np.ones_like(node.weight_steps_O) if task is None else node.scale_KO[task]
    integers = integers * node.over_weight(np.where(scale_O < 0, -1, 1))
    stored = graph.constant(f"{name}_int8", integers, np.int8)
    steps = graph.constant(f"{name}_step", node.weight_steps_O * np.abs(scale_O))
    return graph.add("DequantizeLinear", [stored, steps], name, axis=0)


def export_synapses(graph: Graph, node: SynapseNode, weights: Weights, x: str) -> str:
    """The layer's input currents ``[B, *output_shape]`` for inputs ``x``."""
    name = node.name
    y = _products(node, graph, [weights.weight, *([weights.bias] if weights.bias else [])], x)
    if weights.scale and weights.shift:
        y = graph.add("Mul", [y, weights.scale], f"{name}_scaled")
        y = graph.add("Add", [y, weights.shift], f"{name}_shifted")
    return _competition(node, graph, y)


@singledispatch
def _products(node: SynapseNode, graph: Graph, weights: list[str], x: str) -> str:
    """``W x``, and the bias if there is one, for inputs ``x``."""
    raise no_rule("ONNX", node, _products.registry, _REMEDY)


@_products.register
def _(node: Conv, graph: Graph, weights: list[str], x: str) -> str:
    padded = {"pads": [*node.padding, *node.padding]} if node.padding != (0, 0) else {}
    return graph.add("Conv", [x, *weights], f"{node.name}_synapses", strides=list(node.stride), **padded)


@_products.register
def _(node: Dense, graph: Graph, weights: list[str], x: str) -> str:
    flat = graph.add("Flatten", [x], f"{node.name}_input", axis=1)
    return graph.add("Gemm", [flat, *weights], f"{node.name}_synapses", transB=1)


@_products.register
def _(node: TaskDense, graph: Graph, weights: list[str], x: str) -> str:
    """The outputs of all tasks, then of each row those of its task."""
    name = node.name
    flat = graph.add("Flatten", [x], f"{name}_input", axis=1)
    every = graph.add("Gemm", [flat, *weights], f"{name}_of_all_tasks", transB=1)
    shape = graph.constant(f"{name}_by_task", [0, -1, node.outputs], np.int64)
    by_task = graph.add("Reshape", [every, shape], f"{name}_tasks")
    index = graph.add("Unsqueeze", [TASK, graph.constant("axis_1", [1], np.int64)], f"{name}_task")
    return graph.add("GatherND", [by_task, index], f"{name}_synapses", batch_dims=1)


@singledispatch
def _competition(node: SynapseNode, graph: Graph, current: str) -> str:
    """The currents that are left when a layer's outputs have competed."""
    raise no_rule("ONNX", node, _competition.registry, _REMEDY)


@_competition.register(Conv)
@_competition.register(TaskDense)
def _(node: SynapseNode, graph: Graph, current: str) -> str:
    return current


@_competition.register
def _(node: Dense, graph: Graph, current: str) -> str:
    if node.k_winners is None:
        return current
    name, group = node.name, node.output_shape[0] // node.groups
    grouped = graph.constant(f"{name}_groups", [0, node.groups, group], np.int64)
    parts = graph.add("Reshape", [current, grouped], f"{name}_parts")
    count = graph.constant(f"{name}_k", [node.k_winners], np.int64)
    top, winners = f"{name}_top", f"{name}_winners"
    graph.add("TopK", [parts, count], top, winners, name=f"{name}/TopK", axis=-1)
    nothing = graph.add("Mul", [parts, graph.constant("zero", 0.0)], f"{name}_nothing")
    kept = graph.add("ScatterElements", [nothing, winners, top], f"{name}_kept", axis=2)
    return graph.add("Flatten", [kept], f"{name}_current", axis=1)


@singledispatch
def export_neurons(neurons: NeuronNode, graph: Graph, layer: Layer, current: str) -> str:
    """One simulation step of a layer's neurons: the operators of their equation, by node type.

    Args:
        neurons: the layer's, as its rule is picked by it.
        graph: where the operators go.
        layer: gives the names. Each state variable of the node is the value ``<state>_<layer>``; a rule defines
            ``<state>_<layer>_next``.
        current: name of the input currents ``[B, *output_shape]`` of the step.

    Returns:
        The name of the spikes, or of an ANN's activations: floats ``[B, *output_shape]``, named ``spikes_<layer>``.

    Raises:
        ExportError: a node without a rule.
    """
    raise no_rule("ONNX", neurons, export_neurons.registry, _NEURON_REMEDY)


@export_neurons.register
def _(neurons: ReLUNode, graph: Graph, layer: Layer, current: str) -> str:
    return graph.add("Relu", [current], f"{layer.name}_activity")


@export_neurons.register
def _(neurons: LeakyNode, graph: Graph, layer: Layer, current: str) -> str:
    name = layer.name
    threshold = graph.constant(f"{name}_threshold", by_channel(layer, neurons.threshold_O))
    u, following = f"membrane_{name}", f"membrane_{name}_next"
    owed = graph.add("Greater", [u, threshold], f"{name}_reset_owed")
    if neurons.reset == "zero":
        u = graph.add("Where", [owed, graph.constant("zero", 0.0), u], f"{name}_after_reset")
    if (neurons.beta_O != 1.0).any():
        u = graph.add("Mul", [u, graph.constant(f"{name}_beta", by_channel(layer, neurons.beta_O))], f"{name}_decayed")
    if neurons.reset == "zero":
        graph.add("Add", [u, current], following)
    else:
        u = graph.add("Add", [u, current], f"{name}_charged")
        amount = graph.add("Where", [owed, threshold, graph.constant("zero", 0.0)], f"{name}_reset_by")
        graph.add("Sub", [u, amount], following)
    return spikes_above(graph, layer, following, threshold)


@export_neurons.register
def _(neurons: SynapticNode, graph: Graph, layer: Layer, current: str) -> str:
    name = layer.name
    threshold, beta, alpha = (
        graph.constant(f"{name}_{of}", by_channel(layer, values_O))
        for of, values_O in (("threshold", neurons.threshold_O), ("beta", neurons.beta_O), ("alpha", neurons.alpha_O))
    )
    u, following = f"membrane_{name}", f"membrane_{name}_next"
    owed = graph.add("Greater", [u, threshold], f"{name}_reset_owed")
    kept = graph.add("Mul", [f"current_{name}", alpha], f"{name}_current_decayed")
    synaptic = graph.add("Add", [kept, current], f"current_{name}_next")
    charged = graph.add("Add", [graph.add("Mul", [u, beta], f"{name}_decayed"), synaptic], f"{name}_charged")
    zero = graph.constant("zero", 0.0)
    if neurons.reset == "zero":
        graph.add("Where", [owed, zero, charged], following)
    else:
        graph.add("Sub", [charged, graph.add("Where", [owed, threshold, zero], f"{name}_reset_by")], following)
    return spikes_above(graph, layer, following, threshold)


@export_neurons.register
def _(neurons: AdaptiveNode, graph: Graph, layer: Layer, current: str) -> str:
    name = layer.name
    rest, beta, decay, strength = (
        graph.constant(f"{name}_{of}", by_channel(layer, values_O))
        for of, values_O in (
            ("threshold", neurons.threshold_O),
            ("beta", neurons.beta_O),
            ("adaptation_decay", neurons.adaptation_decay_O),
            ("adaptation_strength", neurons.adaptation_strength_O),
        )
    )
    u, following = f"membrane_{name}", f"membrane_{name}_next"
    a, adapted = f"threshold_adaptation_{name}", f"threshold_adaptation_{name}_next"
    rise = graph.add("Mul", [a, strength], f"{name}_rise")
    crossed = graph.add("Add", [rest, rise], f"{name}_crossed")
    spiked = graph.add("Greater", [u, crossed], f"{name}_reset_owed")
    zero = graph.constant("zero", 0.0)
    if neurons.reset == "zero":
        u = graph.add("Where", [spiked, zero, u], f"{name}_after_reset")
        graph.add("Add", [graph.add("Mul", [u, beta], f"{name}_decayed"), current], following)
    else:
        charged = graph.add("Add", [graph.add("Mul", [u, beta], f"{name}_decayed"), current], f"{name}_charged")
        graph.add("Sub", [charged, graph.add("Where", [spiked, crossed, zero], f"{name}_reset_by")], following)
    jump = graph.add("Cast", [spiked], f"{name}_jump", to=FLOAT)
    graph.add("Add", [graph.add("Mul", [a, decay], f"{name}_adaptation_decayed"), jump], adapted)
    risen = graph.add("Mul", [adapted, strength], f"{name}_next_rise")
    return spikes_above(graph, layer, following, graph.add("Add", [rest, risen], f"{name}_next_threshold"))


def spikes_above(graph: Graph, layer: Layer, membrane: str, threshold: str) -> str:
    """The spikes: where the membrane is strictly above the threshold."""
    fired = graph.add("Greater", [membrane, threshold], f"{layer.name}_fired")
    return graph.add("Cast", [fired], f"spikes_{layer.name}", to=FLOAT)


def by_channel(layer: Layer, values_O: Array) -> Array:
    """Values per output channel, shaped to broadcast over the layer's output."""
    return values_O.reshape(-1, *(1,) * (len(layer.output_shape) - 1))
