"""ONNX graphs of a folded network: one file per use, operators of the standard domain only, dynamic batch axis.

- ``decision``: raw observation (and task) -> Q-values and spike counts, the T simulation steps inside as one Scan.
- ``step``: one simulation step with every neuron state as an input and an output, for hosts that stream.

A membrane is U(t) *before* the reset that its own spike causes, as everywhere in this package (see
``switchmt_snn.spiking.neurons``). Each node of the network has its rule in
``switchmt_snn.export.formats.onnx_nodes``, each encoding in ``switchmt_snn.export.formats.onnx_encodings``.

Shapes: T simulation steps, B batch, O outputs of a layer, K tasks, A actions, L neuron layers.
"""

from __future__ import annotations

import json

import numpy as np
import onnx
from onnx import helper, numpy_helper

from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import metadata
from switchmt_snn.export.formats.onnx_encodings import encode, observation_input
from switchmt_snn.export.formats.onnx_graph import FLOAT, INT32, INT64, OPSET, TASK, Graph
from switchmt_snn.export.formats.onnx_nodes import Weights, export_neurons, export_synapses, weights_of
from switchmt_snn.spiking.folding import FoldedNetwork

_IR_VERSION = 8
NEVER_CHOSEN = -(2.0**100)
"""``q_step`` of an action that the task does not have: finite, so that every readout is a number far below others."""


def decision_model(network: FoldedNetwork, task: int | None = None, unroll: bool = False) -> onnx.ModelProto:
    """The whole decision, for all tasks (input ``task`` int64 ``[B]``) or for one.

    Inputs are ``observation`` ``[B, *shape]``, raw (uint8 frames or float32 vectors; scaling and encoding are inside);
    with the random encoding ``rate`` it is ``encoded`` float32 ``[T, B, *shape]`` instead: the spikes that the host
    drew. Outputs are ``q_values`` ``[B, A]``, -inf where an action does not exist in the task, and for spiking networks
    ``spike_counts`` int64 ``[B, L]``: spikes of each neuron layer over T.

    Args:
        network: for all its tasks.
        task: fold this one in; None takes it as an input.
        unroll: the operators of a step T times one after the other, for runtimes without Scan; ``spike_counts`` are
            then int32, as tract gives no int64 out.

    Raises:
        ExportError: a node without a rule, or nothing to unroll.
    """
    if unroll and not network.spiking:
        raise ExportError(
            f"{network.settings.method} has no simulation steps, expected a spiking method to unroll; its "
            "decision.onnx has no Scan"
        )
    graph, network = Graph(), network if task is None else network.of_task(task)
    inputs = [observation_input(network)]
    if task is None:
        inputs.append(_task_input(graph, network))
    weights = {node.name: weights_of(graph, node, task) for node in network.synapses}
    encoded = encode(graph, network)
    outputs = [helper.make_tensor_value_info("q_values", FLOAT, ["batch", len(network.actions)])]
    if network.spiking:
        q = _over_time(graph, network, weights, encoded, unroll)
        counts = INT32 if unroll else INT64
        outputs.append(helper.make_tensor_value_info("spike_counts", counts, ["batch", len(network.layers)]))
    else:
        x = encoded
        for layer in network.layers:
            current = export_synapses(graph, layer.synapses, weights[layer.name], x)
            x = export_neurons(layer.neurons, graph, layer, current)
        q = export_synapses(graph, network.head, weights["head"], x)
    _mask(graph, network, q, task, "q_values", -np.inf)
    return _model(graph, network, "decision", inputs, outputs, task)


def step_model(network: FoldedNetwork, task: int | None = None) -> onnx.ModelProto:
    """One simulation step of a spiking network.

    Inputs are ``encoded`` float32 ``[B, *shape]`` (what the encoding gives for this step; direct: observation x scale),
    ``task`` unless the file is for one, and the state of each neuron layer, zeros at a decision's start:
    ``membrane_<layer>`` and what else its model keeps. Outputs are ``q_step`` ``[B, A]``, the head's output for this
    step's spikes (the host applies the readout; its mean over T is Q; ``NEVER_CHOSEN`` where an action does not exist),
    ``spikes_<layer>``, and each state's next value as ``<state>_<layer>_next``.

    Raises:
        ExportError: the network does not spike.
    """
    if not network.spiking:
        raise ExportError("an ANN method has no simulation steps, expected a spiking one; use the decision graph")
    graph, network = Graph(), network if task is None else network.of_task(task)
    inputs = [helper.make_tensor_value_info("encoded", FLOAT, ["batch", *network.encoded_shape])]
    if task is None:
        inputs.append(_task_input(graph, network))
    weights = {node.name: weights_of(graph, node, task) for node in network.synapses}
    outputs = [helper.make_tensor_value_info("q_step", FLOAT, ["batch", len(network.actions)])]
    x = "encoded"
    for layer in network.layers:
        shape: list[str | int | None] = ["batch", *layer.output_shape]
        states = [f"{state}_{layer.name}" for state in layer.neurons.states]
        inputs += [helper.make_tensor_value_info(state, FLOAT, shape) for state in states]
        given = [f"spikes_{layer.name}", *(f"{state}_next" for state in states)]
        outputs += [helper.make_tensor_value_info(name, FLOAT, shape) for name in given]
        current = export_synapses(graph, layer.synapses, weights[layer.name], x)
        x = export_neurons(layer.neurons, graph, layer, current)
    q = export_synapses(graph, network.head, weights["head"], x)
    _mask(graph, network, q, task, "q_step", NEVER_CHOSEN)
    return _model(graph, network, "step", inputs, outputs, task)


def _model(
    graph: Graph,
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
        facts |= {"task": network.tasks[task], "tasks": [network.tasks[task]]}
    helper.set_model_props(model, {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()})
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        reason = " ".join(str(error).split())
        raise ExportError(f"the {name} graph is no valid ONNX ({reason:.200}), expected one; mend its rules") from error
    return model


def _over_time(graph: Graph, network: FoldedNetwork, weights: dict[str, Weights], encoded: str, unroll: bool) -> str:
    """The T steps and the readout; returns Q ``[B, A]`` and defines ``spike_counts``."""
    layers, readout, timesteps = network.layers, network.readout, network.settings.timesteps
    if (
        network.constant_input
    ):  # the first layer's current is the same at every step: computed once, seen from within the Scan
        current = export_synapses(graph, layers[0].synapses, weights[layers[0].name], encoded)
        steps = "" if unroll else graph.constant("steps", np.arange(timesteps), np.int64)  # what a Scan goes over
        batch_of, batch_axis = current, 0
    else:
        current, steps, batch_of, batch_axis = "", encoded, encoded, 1
    body = graph.inner()
    x = "encoded_step"
    counts = []
    for index, layer in enumerate(layers):
        first = network.constant_input and index == 0
        fed = current if first else export_synapses(body, layer.synapses, weights[layer.name], x)
        x = export_neurons(layer.neurons, body, layer, fed)
        axes = graph.constant(f"{layer.name}_axes", list(range(1, 1 + len(layer.output_shape))), np.int64)
        total = body.add("ReduceSum", [x, axes], f"{layer.name}_total", keepdims=0)
        counts.append(body.add("Unsqueeze", [total, graph.constant("axis_1", [1], np.int64)], f"{layer.name}_count"))
    step_counts = body.add("Concat", counts, "step_counts", axis=1)
    body.add("Add", ["counts", step_counts], "counts_next")
    states = {f"{state}_{layer.name}": layer.output_shape for layer in layers for state in layer.neurons.states}
    states["counts"] = (len(layers),)
    if readout.kind == "mean":
        states["spike_sum"] = network.head.input_shape
        body.add("Add", ["spike_sum", x], "spike_sum_next")
    else:
        states["readout"] = network.head.output_shape
        decayed = body.add("Mul", ["readout", graph.constant("readout_beta", readout.beta)], "readout_decayed")
        body.add("Add", [decayed, export_synapses(body, network.head, weights["head"], x)], "readout_next")
        if readout.kind == "max_membrane":
            states["largest"] = network.head.output_shape
            body.add("Max", ["largest", "readout_next"], "largest_next")
    starts = _starts(graph, states, batch_of, batch_axis)
    if unroll:
        _unrolled(graph, body, starts, None if network.constant_input else encoded, timesteps)
    else:
        _scan(graph, body, states, starts, steps)
    graph.add("Cast", ["counts_final"], "spike_counts", to=INT32 if unroll else INT64)
    if readout.kind != "mean":
        return "readout_final" if readout.kind == "last_membrane" else "largest_final"
    rate = graph.add("Div", ["spike_sum_final", graph.constant("timesteps", timesteps)], "mean_spikes")
    return export_synapses(graph, network.head, weights["head"], rate)


def _starts(graph: Graph, states: dict[str, tuple[int, ...]], batch_of: str, batch_axis: int) -> dict[str, str]:
    """A start of each state for the batch of a value: zero, or of ``largest`` -inf."""
    shape = graph.add("Shape", [batch_of], "batch", start=batch_axis, end=batch_axis + 1)
    starts = {}
    for name, dims in states.items():
        full = graph.add("Concat", [shape, graph.constant(f"{name}_dims", dims, np.int64)], f"{name}_shape", axis=0)
        start = numpy_helper.from_array(np.asarray([-np.inf if name == "largest" else 0.0], np.float32))
        starts[name] = graph.add("ConstantOfShape", [full], f"{name}_start", value=start)
    return starts


def _unrolled(graph: Graph, body: Graph, starts: dict[str, str], encoded: str | None, timesteps: int) -> None:
    """The operators of a step T times: each step's values have names of their own."""
    inside = {name for node in body.nodes for name in node.output}
    before = starts
    for step in range(timesteps):
        names = {name: f"step{step}/{name}" for name in inside} | before
        if encoded is not None:
            at = graph.constant(f"step{step}/index", step, np.int64)
            names["encoded_step"] = graph.add("Gather", [encoded, at], f"step{step}/encoded", axis=0)
        for node in body.nodes:
            if any(attribute.HasField("g") or attribute.graphs for attribute in node.attribute):
                raise ExportError(
                    f"the operator {node.name} ({node.op_type}) has a graph of its own, expected none in a step that "
                    "is unrolled; leave --unroll out"
                )
            copied = onnx.NodeProto()
            copied.CopyFrom(node)
            copied.name = f"step{step}/{node.name}"
            for part in (copied.input, copied.output):
                part[:] = [names.get(name, name) for name in part]
            graph.nodes.append(copied)
        before = {name: names[f"{name}_next"] for name in starts}
    for name, last in before.items():
        graph.add("Identity", [last], f"{name}_final")


def _scan(graph: Graph, body: Graph, states: dict[str, tuple[int, ...]], starts: dict[str, str], steps: str) -> None:
    """Add the Scan: every state ends as ``<state>_final``."""
    step_dtype = INT64 if steps == "steps" else FLOAT
    values = {name: [None, *dims] for name, dims in states.items()}
    proto = helper.make_graph(
        body.nodes,
        "simulation_step",
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in values.items()]
        + [helper.make_tensor_value_info("encoded_step", step_dtype, None)],
        [helper.make_tensor_value_info(f"{name}_next", FLOAT, shape) for name, shape in values.items()],
    )
    finals = [f"{name}_final" for name in states]
    graph.nodes.append(
        helper.make_node("Scan", [*starts.values(), steps], finals, name="simulation", body=proto, num_scan_inputs=1)
    )


def _task_input(graph: Graph, network: FoldedNetwork) -> onnx.ValueInfoProto:
    """The input ``task``. ONNX counts a negative index from the end: it is moved out of range, and refused."""
    negative = graph.add("Less", ["task", graph.constant("first_task", 0, np.int64)], "task_is_negative")
    beyond = graph.constant("number_of_tasks", len(network.tasks), np.int64)
    graph.add("Where", [negative, beyond, "task"], TASK)
    return helper.make_tensor_value_info("task", INT64, ["batch"])


def _mask(graph: Graph, network: FoldedNetwork, q: str, task: int | None, output: str, masked: float) -> None:
    """Define an output: Q, and another value where the task does not have the action.

    With the input ``task``, the look-up is also what refuses a task that does not exist.
    """
    valid_KA = network.valid_actions_KA if task is None else network.valid_actions_KA[[task]]
    if task is not None and valid_KA.all():
        graph.add("Identity", [q], output)
        return
    valid = graph.constant("valid_actions", valid_KA, np.bool_)
    if task is None:
        valid = graph.add("Gather", [valid, TASK], "valid_here", axis=0)
    graph.add("Where", [valid, q, graph.constant("masked", masked)], output)
