"""What an ONNX file may hold: operators whose time and memory follow from the sizes of their inputs, no other files.

With these, a model that ran once on a batch runs on every batch of that size: no value decides how long it takes.
"""

from __future__ import annotations

from collections.abc import Iterator

import onnx
from onnx import numpy_helper

MOST_NODES = 100_000
"""Of all graphs of a file; ``unrolled.onnx`` has about 15 for each layer and simulation step."""
MOST_LEVELS = 4
"""Of graphs within graphs: a Scan has one."""
_BY_INPUT = frozenset((
    "Abs", "Acos", "Acosh", "Add", "And", "ArgMax", "ArgMin", "Asin", "Asinh", "Atan", "Atanh", "AveragePool",
    "BatchNormalization", "BitShift", "BitwiseAnd", "BitwiseNot", "BitwiseOr", "BitwiseXor", "Cast", "CastLike",
    "Ceil", "Celu", "Clip", "Compress", "Concat", "Constant", "Conv", "Cos", "Cosh", "CumSum", "DequantizeLinear",
    "Div", "Dropout", "Elu", "Equal", "Erf", "Exp", "Flatten", "Floor", "Gather", "GatherElements", "GatherND",
    "Gelu", "Gemm", "GlobalAveragePool", "GlobalMaxPool", "Greater", "GreaterOrEqual", "HardSigmoid", "HardSwish",
    "Identity", "IsInf", "IsNaN", "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual", "Log", "LogSoftmax",
    "MatMul", "Max", "MaxPool", "Mean", "Min", "Mish", "Mod", "Mul", "Neg", "Not", "Or", "PRelu", "Pow",
    "QuantizeLinear", "Reciprocal", "ReduceL1", "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMax",
    "ReduceMean", "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare", "Relu", "Reshape", "Round", "Scan",
    "ScatterElements", "ScatterND", "Selu", "Shape", "Sigmoid", "Sign", "Sin", "Sinh", "Size", "Slice", "Softmax",
    "Softplus", "Softsign", "Split", "Sqrt", "Squeeze", "Sub", "Sum", "Tan", "Tanh", "ThresholdedRelu", "TopK",
    "Transpose", "Trilu", "Unsqueeze", "Where", "Xor",
))  # fmt: skip
"""Operators whose output is never larger than the shapes and attributes of their inputs say."""
_BY_VALUE = {"ConstantOfShape": 0, "Range": 0, "EyeLike": 0, "Expand": 1, "Tile": 1, "Pad": 1, "OneHot": 1}
"""Operators whose output's size is a value of an input, from this input on: such a value must be known."""


def require_plain(model: onnx.ModelProto) -> None:
    """Refuse a model that refers to other files, brings code, or has operators whose cost a value decides.

    Raises:
        ValueError: naming what was found.
    """
    if model.functions or model.training_info:
        raise ValueError("it brings functions or training graphs, expected one graph")
    domains = sorted({entry.domain for entry in model.opset_import} - {"", "ai.onnx"})
    if domains:
        raise ValueError(f"it uses the operators of {domains[0]!r:.60}, expected those of ONNX only")
    if not model.HasField("graph"):
        raise ValueError("it has no graph")
    left = [MOST_NODES]
    _require_graph(model.graph, frozenset(), 1, left)


def _require_graph(graph: onnx.GraphProto, outside: frozenset[str], level: int, left: list[int]) -> None:
    if level > MOST_LEVELS:
        raise ValueError(f"it has graphs in more than {MOST_LEVELS} levels")
    for tensor in (*graph.initializer, *(part for s in graph.sparse_initializer for part in (s.values, s.indices))):
        _require_inside(tensor)
    # Values that no input of the model changes, and shapes, which the batch alone changes.
    known = (outside | {tensor.name for tensor in graph.initializer}) - {value.name for value in graph.input}
    for node in graph.node:
        left[0] -= 1
        if left[0] < 0:
            raise ValueError(f"it has more than {MOST_NODES:,} operators")
        if node.domain not in ("", "ai.onnx") or (node.op_type not in _BY_INPUT and node.op_type not in _BY_VALUE):
            name = f"{node.domain}:{node.op_type}" if node.domain else node.op_type
            raise ValueError(
                f"it has the operator {name!s:.60}, expected one whose cost follows from the sizes of its inputs"
            )
        for part in _attached(node):
            if isinstance(part, onnx.TensorProto):
                _require_inside(part)
            else:
                _require_graph(part, frozenset(known), level + 1, left)
        sizes = [name for name in node.input[_BY_VALUE.get(node.op_type, len(node.input)) :] if name]
        unknown = [name for name in sizes if name not in known]
        if unknown:
            raise ValueError(
                f"the size of {node.output[0] if node.output else ''!r:.60} depends on values of its inputs"
            )
        if node.op_type in ("Shape", "Size") or all(name in known for name in node.input if name):
            known = known | set(node.output)


def _attached(node: onnx.NodeProto) -> Iterator[onnx.TensorProto | onnx.GraphProto]:
    """Tensors and graphs in a node's attributes."""
    for attribute in node.attribute:
        if attribute.HasField("t"):
            yield attribute.t
        if attribute.HasField("g"):
            yield attribute.g
        if attribute.HasField("sparse_tensor"):
            yield attribute.sparse_tensor.values
            yield attribute.sparse_tensor.indices
        yield from attribute.tensors
        yield from attribute.graphs
        for sparse in attribute.sparse_tensors:
            yield sparse.values
            yield sparse.indices


def _require_inside(tensor: onnx.TensorProto) -> None:
    if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
        raise ValueError(f"it keeps weights in other files ({tensor.name!r:.60}), expected one whole file")
    if tensor.data_type in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
        values = numpy_helper.to_array(tensor)
        if (values != values).any():
            raise ValueError(f"{tensor.name!r:.60} holds a number that is not finite, expected finite weights")
