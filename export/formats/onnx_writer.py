"""ONNX graphs of a folded network: one file per use, operators of the standard domain only, dynamic batch axis.

- ``decision``: raw observation (and task) -> Q-values and spike counts, the T simulation steps inside as one Scan.
- ``step``: one simulation step with every membrane as an input and an output, for hosts that stream.

Neuron state is the membrane U(t) *before* the reset that its own spike causes, as everywhere in this package (see
:mod:`switchmt_snn.spiking.neurons`). The graphs are built operator by operator, so that a file is a function of the
network alone and names mean something.

Shapes: T simulation steps, B batch, O outputs of a layer, K tasks, A actions, L neuron layers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from switchmt_snn.errors import ExportError
from switchmt_snn.export.folding import FoldedNetwork, Layer, Neurons, metadata

OPSET = 18
"""Operator set of the files (that of ONNX 1.13)."""
_IR_VERSION = 8

_FLOAT, _INT64 = TensorProto.FLOAT, TensorProto.INT64


@dataclass
class _Graph:
    """Nodes of one (sub)graph; constants go to the outermost one."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: dict[str, onnx.TensorProto] = field(default_factory=dict)

    def inner(self) -> _Graph:
        return _Graph([], self.constants)

    def constant(self, name: str, value: npt.ArrayLike, dtype: npt.DTypeLike = np.float32) -> str:
        if name not in self.constants:
            self.constants[name] = numpy_helper.from_array(np.asarray(value, dtype), name)
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=f"{output}/{operator}", **attributes))
        return output


@dataclass(frozen=True)
class _Weights:
    """Names of a layer's constants in a graph; scale and shift only where one file serves several tasks."""

    weight: str
    bias: str | None
    scale: str | None
    shift: str | None


def decision_model(network: FoldedNetwork, task: int | None = None) -> onnx.ModelProto:
    """The whole decision, for all tasks (input ``task`` int64 ``[B]``) or for one.

    Inputs are ``observation`` ``[B, *shape]``, raw (uint8 frames or float32 vectors; scaling and encoding are inside);
    with the random encoding ``rate`` it is ``encoded`` float32 ``[T, B, *shape]`` instead: the spikes that the host
    drew. Outputs are ``q_values`` ``[B, A]``, -inf where an action does not exist in the task, and for spiking networks
    ``spike_counts`` int64 ``[B, L]``: spikes of each neuron layer over T.
    """
    graph = _Graph()
    inputs = [_observation_input(network)]
    if task is None:
        inputs.append(helper.make_tensor_value_info("task", _INT64, ["batch"]))
    weights = {layer.name: _layer_weights(graph, layer, task) for layer in network.layers}
    encoded = _encode(graph, network)
    outputs = [helper.make_tensor_value_info("q_values", _FLOAT, ["batch", len(network.suite.action_names)])]
    if network.spiking:
        q = _over_time(graph, network, weights, encoded)
        outputs.append(helper.make_tensor_value_info("spike_counts", _INT64, ["batch", len(network.hidden_layers)]))
    else:
        x = encoded
        for layer in network.hidden_layers:
            x = graph.add("Relu", [_current(graph, layer, weights[layer.name], x)], f"{layer.name}_activity")
        q = _current(graph, network.head, weights["head"], x)
    _mask(graph, network, q, task)
    return _model(graph, network, "decision", inputs, outputs, task)


def step_model(network: FoldedNetwork, task: int | None = None) -> onnx.ModelProto:
    """One simulation step of a spiking network.

    Inputs are ``encoded`` float32 ``[B, *shape]`` (what the encoding gives for this step; direct: observation x scale),
    ``task`` unless the file is for one, and ``membrane_<layer>`` for each neuron layer (zeros at a decision's start).
    Outputs are ``q_step`` ``[B, A]``, the head's output for this step's spikes (the host applies the readout; its mean
    over T is Q), ``spikes_<layer>``, and ``membrane_<layer>_next``.

    Raises:
        ExportError: the network does not spike.
    """
    if not network.spiking:
        raise ExportError("an ANN method has no simulation steps, expected a spiking one; use the decision graph")
    graph = _Graph()
    inputs = [helper.make_tensor_value_info("encoded", _FLOAT, ["batch", *network.encoded_shape])]
    if task is None:
        inputs.append(helper.make_tensor_value_info("task", _INT64, ["batch"]))
    weights = {layer.name: _layer_weights(graph, layer, task) for layer in network.layers}
    outputs = [helper.make_tensor_value_info("q_step", _FLOAT, ["batch", len(network.suite.action_names)])]
    x = "encoded"
    for layer in network.hidden_layers:
        shape: list[str | int | None] = ["batch", *layer.output_shape]
        inputs.append(helper.make_tensor_value_info(f"membrane_{layer.name}", _FLOAT, shape))
        outputs.append(helper.make_tensor_value_info(f"spikes_{layer.name}", _FLOAT, shape))
        outputs.append(helper.make_tensor_value_info(f"membrane_{layer.name}_next", _FLOAT, shape))
        x = _fire(graph, layer, _current(graph, layer, weights[layer.name], x))
    graph.add("Identity", [_current(graph, network.head, weights["head"], x)], "q_step")
    return _model(graph, network, "step", inputs, outputs, task)


def _model(
    graph: _Graph,
    network: FoldedNetwork,
    name: str,
    inputs: list[onnx.ValueInfoProto],
    outputs: list[onnx.ValueInfoProto],
    task: int | None,
) -> onnx.ModelProto:
    proto = helper.make_graph(graph.nodes, name, inputs, outputs, list(graph.constants.values()))
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=_IR_VERSION)
    model.producer_name = "switchmt-snn"
    facts = metadata(network)
    if task is not None:
        facts |= {"task": network.suite.names[task], "tasks": [network.suite.names[task]]}
    helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()})
    onnx.checker.check_model(model, full_check=True)
    return model


def _observation_input(network: FoldedNetwork) -> onnx.ValueInfoProto:
    if network.config.network.encoding == "rate":
        shape: list[str | int | None] = [network.config.network.timesteps, "batch", *network.encoded_shape]
        return helper.make_tensor_value_info("encoded", _FLOAT, shape)
    dtype = helper.np_dtype_to_tensor_dtype(np.dtype(network.suite.frame_dtype))
    return helper.make_tensor_value_info("observation", dtype, ["batch", *network.suite.observation_shape])


def _encode(graph: _Graph, network: FoldedNetwork) -> str:
    """The encoded input: ``[B, ...]`` under direct encoding (the same at every step), else ``[T, B, ...]``."""
    settings, stack = network.config.network, network.suite.frame_stack
    if settings.encoding == "rate":
        return "encoded"
    raw = graph.add("Cast", ["observation"], "observation_float", to=_FLOAT)
    x = graph.add("Mul", [raw, graph.constant("scale", network.suite.scale)], "scaled")
    if settings.encoding == "direct":
        return x
    if settings.encoding == "latency":
        T = settings.timesteps
        dark = graph.add("Sub", [graph.constant("one", 1.0), x], "darkness")
        when = graph.add("Round", [graph.add("Mul", [dark, graph.constant("last_step", T - 1)], "delay")], "when")
        steps = np.arange(T).reshape(T, *(1,) * (1 + len(network.suite.observation_shape)))
        now = graph.add("Equal", [when, graph.constant("steps", steps)], "now")
        lit = graph.add("Greater", [x, graph.constant("zero", 0.0)], "lit")
        return graph.add("Cast", [graph.add("And", [now, lit], "fires")], "encoded", to=_FLOAT)
    c, *rest = network.suite.frame_shape
    unstacked = graph.add("Reshape", [x, graph.constant("unstack", [0, stack, c, *rest], np.int64)], "unstacked")
    order = [1, 0, *range(2, 3 + len(rest))]
    frames = graph.add("Transpose", [unstacked], "frames", perm=order)
    if settings.encoding == "frames":
        return frames
    start, end, axis = (graph.constant(n, [v], np.int64) for n, v in (("at_0", 0), ("at_last", -1), ("axis_0", 0)))
    older = graph.add("Slice", [frames, start, end, axis], "older")
    first = graph.add("Slice", [frames, start, graph.constant("at_1", [1], np.int64), axis], "first")
    darkness = graph.add("Mul", [first, graph.constant("zero", 0.0)], "darkness")
    before = graph.add("Concat", [darkness, older], "before", axis=0)
    change = graph.add("Sub", [frames, before], "change")
    on = graph.add("Greater", [change, graph.constant("on_above", settings.event_threshold)], "on")
    off = graph.add("Less", [change, graph.constant("off_below", -settings.event_threshold)], "off")
    return graph.add("Cast", [graph.add("Concat", [on, off], "events", axis=2)], "encoded", to=_FLOAT)


def _layer_weights(graph: _Graph, layer: Layer, task: int | None) -> _Weights:
    """A layer's constants: of one task folded in, or shared weights with scale and shift picked by ``task``."""
    name = layer.name
    if task is not None or not layer.depends_on_task:
        weight, bias = layer.folded(task or 0)
        return _Weights(_weight(graph, layer, weight, task or 0), graph.constant(f"{name}_bias", bias), None, None)
    terms = []
    for kind, rows in (("scale", layer.scale_KO), ("shift", layer.shift_KO)):
        table = graph.constant(f"{name}_{kind}_by_task", rows)
        row = graph.add("Gather", [table, "task"], f"{name}_{kind}_row", axis=0)
        if layer.is_convolution:
            axes = graph.constant("image_axes", [2, 3], np.int64)
            row = graph.add("Unsqueeze", [row, axes], f"{name}_{kind}")
        terms.append(row)
    return _Weights(_weight(graph, layer, layer.weight, None), None, terms[0], terms[1])


def _weight(graph: _Graph, layer: Layer, weight: npt.NDArray[Any], task: int | None) -> str:
    name = f"{layer.name}_weight"
    if layer.weight_steps_O is None:
        return graph.constant(name, weight)
    shape = (-1, *(1,) * (layer.weight.ndim - 1))
    integers = np.rint(layer.weight / layer.weight_steps_O.reshape(shape))
    scale_O = np.ones_like(layer.weight_steps_O) if task is None else layer.scale_KO[task]
    integers = integers * np.where(scale_O < 0, -1, 1).reshape(shape)
    stored = graph.constant(f"{name}_int8", integers, np.int8)
    steps = graph.constant(f"{name}_step", layer.weight_steps_O * np.abs(scale_O))
    return graph.add("DequantizeLinear", [stored, steps], name, axis=0)


def _current(graph: _Graph, layer: Layer, weights: _Weights, x: str) -> str:
    """The layer's input currents ``[B, *output_shape]`` for inputs ``x``."""
    name, bias = layer.name, [weights.bias] if weights.bias else []
    if layer.is_convolution:
        y = graph.add("Conv", [x, weights.weight, *bias], f"{name}_synapses", strides=[layer.stride] * 2)
    else:
        flat = graph.add("Flatten", [x], f"{name}_input", axis=1)
        y = graph.add("Gemm", [flat, weights.weight, *bias], f"{name}_synapses", transB=1)
    if weights.scale and weights.shift:
        y = graph.add("Mul", [y, weights.scale], f"{name}_scaled")
        y = graph.add("Add", [y, weights.shift], f"{name}_shifted")
    return y if layer.k_winners is None else _keep_k_winners(graph, layer, y)


def _keep_k_winners(graph: _Graph, layer: Layer, current: str) -> str:
    name, group = layer.name, layer.output_shape[0] // layer.groups
    grouped = graph.constant(f"{name}_groups", [0, layer.groups, group], np.int64)
    parts = graph.add("Reshape", [current, grouped], f"{name}_parts")
    count = graph.constant(f"{name}_k", [layer.k_winners or 0], np.int64)
    graph.nodes.append(
        helper.make_node("TopK", [parts, count], [f"{name}_top", f"{name}_winners"], name=f"{name}/TopK", axis=-1)
    )
    nothing = graph.add("Mul", [parts, graph.constant("zero", 0.0)], f"{name}_nothing")
    kept = graph.add("ScatterElements", [nothing, f"{name}_winners", f"{name}_top"], f"{name}_kept", axis=2)
    return graph.add("Flatten", [kept], f"{name}_current", axis=1)


def _fire(graph: _Graph, layer: Layer, current: str) -> str:
    """Update ``membrane_<layer>`` into ``membrane_<layer>_next`` and return the spikes (as floats)."""
    name, neurons = layer.name, layer.neurons
    assert isinstance(neurons, Neurons)
    shape = (-1, *(1,) * (len(layer.output_shape) - 1))
    threshold = graph.constant(f"{name}_threshold", neurons.threshold_O.reshape(shape))
    u = f"membrane_{name}"
    owed = graph.add("Greater", [u, threshold], f"{name}_reset_owed")
    if neurons.reset == "zero":
        u = graph.add("Where", [owed, graph.constant("zero", 0.0), u], f"{name}_after_reset")
    if neurons.kind == "LIF":
        u = graph.add("Mul", [u, graph.constant(f"{name}_beta", neurons.beta_O.reshape(shape))], f"{name}_decayed")
    following = f"membrane_{name}_next"
    if neurons.reset == "zero":
        graph.add("Add", [u, current], following)
    else:
        u = graph.add("Add", [u, current], f"{name}_charged")
        amount = graph.add("Where", [owed, threshold, graph.constant("zero", 0.0)], f"{name}_reset_by")
        graph.add("Sub", [u, amount], following)
    fired = graph.add("Greater", [following, threshold], f"{name}_fired")
    return graph.add("Cast", [fired], f"spikes_{name}", to=_FLOAT)


def _over_time(graph: _Graph, network: FoldedNetwork, weights: dict[str, _Weights], encoded: str) -> str:
    """The Scan over T steps and the readout; returns Q ``[B, A]`` and defines ``spike_counts``."""
    settings, layers = network.config.network, network.hidden_layers
    direct = settings.encoding == "direct"
    if direct:  # the first layer's current is the same at every step: computed once, seen from within the Scan
        current = _current(graph, layers[0], weights[layers[0].name], encoded)
        steps = graph.constant("steps", np.arange(settings.timesteps), np.int64)
        batch_of, batch_axis = current, 0
    else:
        current, steps, batch_of, batch_axis = "", encoded, encoded, 1
    body = graph.inner()
    x = "encoded_step"
    counts = []
    for index, layer in enumerate(layers):
        first = direct and index == 0
        x = _fire(body, layer, current if first else _current(body, layer, weights[layer.name], x))
        axes = graph.constant(f"{layer.name}_axes", list(range(1, 1 + len(layer.output_shape))), np.int64)
        total = body.add("ReduceSum", [x, axes], f"{layer.name}_total", keepdims=0)
        counts.append(body.add("Unsqueeze", [total, graph.constant("axis_1", [1], np.int64)], f"{layer.name}_count"))
    step_counts = body.add("Concat", counts, "step_counts", axis=1)
    body.add("Add", ["counts", step_counts], "counts_next")
    states = {f"membrane_{layer.name}": layer.output_shape for layer in layers} | {"counts": (len(layers),)}
    if settings.readout == "mean":
        states["spike_sum"] = network.head.input_shape
        body.add("Add", ["spike_sum", x], "spike_sum_next")
    else:
        states["readout"] = network.head.output_shape
        decayed = body.add("Mul", ["readout", graph.constant("readout_beta", settings.readout_beta)], "readout_decayed")
        body.add("Add", [decayed, _current(body, network.head, weights["head"], x)], "readout_next")
        if settings.readout == "max_membrane":
            states["largest"] = network.head.output_shape
            body.add("Max", ["largest", "readout_next"], "largest_next")
    _scan(graph, body, states, steps, batch_of, batch_axis)
    graph.add("Cast", ["counts_final"], "spike_counts", to=_INT64)
    if settings.readout != "mean":
        return "readout_final" if settings.readout == "last_membrane" else "largest_final"
    rate = graph.add("Div", ["spike_sum_final", graph.constant("timesteps", settings.timesteps)], "mean_spikes")
    return _current(graph, network.head, weights["head"], rate)


def _scan(
    graph: _Graph, body: _Graph, states: dict[str, tuple[int, ...]], steps: str, batch_of: str, batch_axis: int
) -> None:
    """Add the Scan: every state starts at zero (``largest`` at -inf) and ends as ``<state>_final``."""
    shape = graph.add("Shape", [batch_of], "batch", start=batch_axis, end=batch_axis + 1)
    starts = []
    for name, dims in states.items():
        full = graph.add("Concat", [shape, graph.constant(f"{name}_dims", dims, np.int64)], f"{name}_shape", axis=0)
        start = numpy_helper.from_array(np.asarray([-np.inf if name == "largest" else 0.0], np.float32))
        starts.append(graph.add("ConstantOfShape", [full], f"{name}_start", value=start))
    step_dtype = _INT64 if steps == "steps" else _FLOAT
    values = {name: [None, *dims] for name, dims in states.items()}
    proto = helper.make_graph(
        body.nodes,
        "simulation_step",
        [helper.make_tensor_value_info(name, _FLOAT, shape) for name, shape in values.items()]
        + [helper.make_tensor_value_info("encoded_step", step_dtype, None)],
        [helper.make_tensor_value_info(f"{name}_next", _FLOAT, shape) for name, shape in values.items()],
    )
    finals = [f"{name}_final" for name in states]
    graph.nodes.append(
        helper.make_node("Scan", [*starts, steps], finals, name="simulation", body=proto, num_scan_inputs=1)
    )


def _mask(graph: _Graph, network: FoldedNetwork, q: str, task: int | None) -> None:
    """Define ``q_values``: Q, and -inf where the task does not have the action."""
    valid_KA = network.suite.valid_actions_KA if task is None else network.suite.valid_actions_KA[[task]]
    if valid_KA.all():
        graph.add("Identity", [q], "q_values")
        return
    valid = graph.constant("valid_actions", valid_KA, np.bool_)
    if task is None:
        valid = graph.add("Gather", [valid, "task"], "valid_here", axis=0)
    graph.add("Where", [valid, q, graph.constant("impossible", -np.inf)], "q_values")
