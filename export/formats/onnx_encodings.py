"""The encodings as ONNX operators: the computation of ``switchmt_snn.spiking.encodings``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx
from onnx import helper

from switchmt_snn.errors import ExportError
from switchmt_snn.export.formats.onnx_graph import FLOAT, OPSET, Graph
from switchmt_snn.spiking.encodings import (
    ENCODINGS,
    EVENT_MARGIN,
    Direct,
    Encoding,
    Events,
    Frames,
    Latency,
    encoding_class,
)
from switchmt_snn.spiking.folding import FoldedNetwork

Rule = Callable[[Graph, FoldedNetwork, str], str]
"""Adds an encoding's operators: takes the name of the scaled observation ``[B, *shape]``, returns that of the network's
input, float32 ``[T, B, ...]``; of an encoding that is constant over time ``[B, ...]``."""

RULES: dict[type[Encoding], Rule] = {}
"""By encoding. A random encoding needs none: the host draws its inputs."""


def encoding_rule(encoding: type[Encoding]) -> Callable[[Rule], Rule]:
    """Function decorator: the ONNX operators of an encoding, also of one from outside the package."""

    def register(rule: Rule) -> Rule:
        RULES[encoding] = rule
        return rule

    return register


def observation_input(network: FoldedNetwork) -> onnx.ValueInfoProto:
    """Raw observations ``[B, *shape]``; under a random encoding, the inputs ``[T, B, *shape]`` that the host drew."""
    if encoding_class(network.settings.encoding).is_random:
        shape: list[str | int | None] = [network.settings.timesteps, "batch", *network.encoded_shape]
        return helper.make_tensor_value_info("encoded", FLOAT, shape)
    dtype = helper.np_dtype_to_tensor_dtype(np.dtype(network.observation_dtype))
    return helper.make_tensor_value_info("observation", dtype, ["batch", *network.observation.shape])


def encode(graph: Graph, network: FoldedNetwork) -> str:
    """The encoded input: ``[B, ...]`` under an encoding that is constant over time, else ``[T, B, ...]``.

    Raises:
        ExportError: an encoding without a rule, or one whose rule gives another input than the encoding states.
    """
    encoding = encoding_class(network.settings.encoding)
    if encoding.is_random:
        return "encoded"
    if encoding not in RULES:
        raise ExportError(
            f"ONNX has no rule for network.encoding {network.settings.encoding}, expected one of "
            f"{', '.join(map(_name, RULES))}; add one with @encoding_rule({encoding.__name__}) of "
            "switchmt_snn.export.formats.onnx_encodings"
        )
    before = len(graph.nodes)
    raw = graph.add("Cast", ["observation"], "observation_float", to=FLOAT)
    x = graph.add("Mul", [raw, graph.constant("scale", network.observation.scale)], "scaled")
    encoded = RULES[encoding](graph, network, x)
    _check(graph, graph.nodes[before:], network, encoded)
    return encoded


def _name(encoding: type[Encoding]) -> str:
    """As ``network.encoding`` names it."""
    known = (name for name, registered in ENCODINGS.items() if registered is encoding)
    return next(known, f"{encoding.__module__}:{encoding.__qualname__}")


def _check(graph: Graph, nodes: list[onnx.NodeProto], network: FoldedNetwork, encoded: object) -> None:
    """Refuse what a rule gave if its type or shape is not that of the network's input."""
    rule = f"the ONNX rule of network.encoding {network.settings.encoding}"
    steps = () if network.constant_input else (network.settings.timesteps,)
    expected = (*steps, "batch", *network.encoded_shape)
    used = {name for node in nodes for name in node.input}
    constants = [constant for name, constant in graph.constants.items() if name in used]
    if not any(encoded in node.output for node in nodes):
        raise ExportError(f"{rule} returned {encoded!r:.60}, expected the name of a value that the rule adds")
    output = onnx.ValueInfoProto(name=str(encoded))
    proto = helper.make_graph(nodes, "encoding", [observation_input(network)], [output], constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)])
    try:
        inferred = onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)
    except onnx.shape_inference.InferenceError as error:
        reason = " ".join(str(error).split())
        raise ExportError(f"{rule} adds operators that ONNX refuses ({reason:.160}), expected a valid graph") from error
    found = inferred.graph.output[0].type.tensor_type
    dims = tuple(dim.dim_value or dim.dim_param or "?" for dim in found.shape.dim)
    pairs = zip(dims, expected, strict=False)
    fits = len(dims) == len(expected) and all(isinstance(dim, str) or dim == wanted for dim, wanted in pairs)
    if found.elem_type != FLOAT or not fits:
        dtype = onnx.TensorProto.DataType.Name(found.elem_type)
        raise ExportError(
            f"{rule} gave {dtype} of shape ({', '.join(map(str, dims))}), expected FLOAT of shape "
            f"({', '.join(map(str, expected))}), {'without' if network.constant_input else 'with'} the T steps in front"
        )


@encoding_rule(Direct)
def _direct(graph: Graph, network: FoldedNetwork, x: str) -> str:
    return x


@encoding_rule(Latency)
def _latency(graph: Graph, network: FoldedNetwork, x: str) -> str:
    T = network.settings.timesteps
    dark = graph.add("Sub", [graph.constant("one", 1.0), x], "darkness")
    when = graph.add("Round", [graph.add("Mul", [dark, graph.constant("last_step", T - 1)], "delay")], "when")
    steps = np.arange(T, dtype=np.float32).reshape(T, *(1,) * (1 + len(network.observation.shape)))
    now = graph.add("Equal", [when, graph.constant("steps", steps)], "now")
    lit = graph.add("Greater", [x, graph.constant("zero", 0.0)], "lit")
    return graph.add("Cast", [graph.add("And", [now, lit], "fires")], "encoded", to=FLOAT)


@encoding_rule(Frames)
def _frames(graph: Graph, network: FoldedNetwork, x: str) -> str:
    stack, (channels, *rest) = network.observation.frame_stack, network.observation.shape
    shape = [0, stack, channels // stack, *rest]
    unstacked = graph.add("Reshape", [x, graph.constant("unstack", shape, np.int64)], "unstacked")
    return graph.add("Transpose", [unstacked], "frames", perm=[1, 0, *range(2, 3 + len(rest))])


@encoding_rule(Events)
def _events(graph: Graph, network: FoldedNetwork, x: str) -> str:
    frames = _frames(graph, network, x)
    start, end, axis = (graph.constant(n, [v], np.int64) for n, v in (("at_0", 0), ("at_last", -1), ("axis_0", 0)))
    older = graph.add("Slice", [frames, start, end, axis], "older")
    first = graph.add("Slice", [frames, start, graph.constant("at_1", [1], np.int64), axis], "first")
    darkness = graph.add("Mul", [first, graph.constant("zero", 0.0)], "darkness")
    before = graph.add("Concat", [darkness, older], "before", axis=0)
    change = graph.add("Sub", [frames, before], "change")
    threshold = network.settings.event_threshold + EVENT_MARGIN
    on = graph.add("Greater", [change, graph.constant("on_above", threshold)], "on")
    off = graph.add("Less", [change, graph.constant("off_below", -threshold)], "off")
    return graph.add("Cast", [graph.add("Concat", [on, off], "events", axis=2)], "encoded", to=FLOAT)
