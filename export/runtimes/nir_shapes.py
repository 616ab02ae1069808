"""Shapes of a NIR graph's signals, before anything is computed: they fit each other, and their size is bounded."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import nir
import numpy as np

from switchmt_snn.errors import ExportError
from switchmt_snn.spiking.layers import convolved_sides

MOST_VALUES = 2**24
"""Of all signals of one observation together, and of the windows of one convolution."""
MOST_NODES = 500
_PARAMETERS = {
    "Scale": ("scale",),
    "Threshold": ("threshold",),
    "IF": ("r", "v_threshold", "v_reset"),
    "LIF": ("tau", "r", "v_leak", "v_threshold", "v_reset"),
    "I": ("r",),
    "LI": ("tau", "r", "v_leak"),
    "CubaLIF": ("tau_syn", "tau_mem", "r", "v_leak", "v_threshold", "v_reset", "w_in"),
}
"""Parameters of the nodes that work value by value."""
Shape = tuple[int, ...]
Geometry = Mapping[str, tuple[tuple[int, int], tuple[int, int]]]


def signal_shapes(
    graph: nir.NIRGraph,
    order: Collection[str],
    sources: Mapping[str, list[str]],
    feedback: Collection[tuple[str, str]],
    geometry: Geometry,
) -> dict[str, Shape]:
    """Shape of each node's output, without the batch.

    Args:
        graph: nodes that the interpreter knows.
        order: node names in forward order, Input first.
        sources: what each node receives.
        feedback: edges that close a loop.
        geometry: stride and padding of each Conv2d node.

    Raises:
        ExportError: naming the node whose parameters or sources do not fit, or is too large.
    """
    shapes: dict[str, Shape] = {}
    for name in order:
        node = graph.nodes[name]
        if isinstance(node, nir.Input):
            shapes[name] = _sides(name, node.input_type["input"])
        else:
            arriving = {shapes[source] for source in sources[name] if (source, name) not in feedback}
            if len(arriving) != 1:
                raise ExportError(f"the NIR node {name!s:.60} adds up signals of {len(arriving)} shapes, expected one")
            shapes[name] = _output(name, node, arriving.pop(), geometry)
        size = sum(map(math.prod, shapes.values()))
        if size > MOST_VALUES:
            raise ExportError(
                f"the NIR graph's signals have {size:,} values at {name!s:.60}, expected at most {MOST_VALUES:,}"
            )
    for source, name in feedback:
        before = next(shapes[other] for other in sources[name] if (other, name) not in feedback)
        if shapes[source] != before:
            raise ExportError(f"the NIR node {name!s:.60} adds up signals of 2 shapes, expected one")
    return shapes


def _output(name: str, node: nir.NIRNode, x: Shape, geometry: Geometry) -> Shape:
    if isinstance(node, nir.Conv2d):
        return _convolved(name, node, x, *geometry[name])
    if isinstance(node, (nir.Affine, nir.Linear)):
        outputs, inputs = node.weight.shape
        _require(name, "weights", x[-1:] == (inputs,), f"{inputs} inputs", x)
        bias: Any = getattr(node, "bias", None)
        _require(
            name, "biases", bias is None or np.shape(bias) in ((outputs,), ()), f"shape {np.shape(bias)}", (outputs,)
        )
        return (*x[:-1], outputs)
    if isinstance(node, nir.Flatten):
        return (math.prod(x),)
    for parameter in _PARAMETERS.get(type(node).__name__, ()):
        shape = np.shape(getattr(node, parameter))
        fits = len(shape) <= len(x) and all(a in (1, b) for a, b in zip(shape[::-1], x[::-1], strict=False))
        _require(name, parameter, fits, f"shape {shape}", x)
    return x


def _convolved(name: str, node: nir.Conv2d, x: Shape, stride: tuple[int, int], padding: tuple[int, int]) -> Shape:
    weight = node.weight.shape
    _require(name, "weights", len(x) == 3 and weight[1] == x[0], f"shape {weight}", x)
    _require(name, "biases", np.shape(node.bias) == weight[:1], f"shape {np.shape(node.bias)}", weight[:1])
    sides = convolved_sides(x[1:], weight[2:], stride, padding)
    _require(name, "weights", min(sides) >= 1 and min(weight) >= 1, f"a kernel of {weight[2:]}", x)
    windows = math.prod(sides) * math.prod(weight[1:])
    padded = math.prod(side + 2 * pad for side, pad in zip(x[1:], padding, strict=True)) * x[0]
    if max(windows, padded) > MOST_VALUES:
        most = max(windows, padded)
        raise ExportError(f"the NIR node {name!s:.60} has windows of {most:,} values, expected at most {MOST_VALUES:,}")
    return (weight[0], *sides)


def _sides(name: str, shape: Any) -> Shape:
    sides = np.asarray(shape)
    if sides.ndim != 1 or sides.dtype.kind not in "iu" or not 1 <= len(sides) <= 8 or (sides < 1).any():
        raise ExportError(
            f"the NIR node {name!s:.60} has the shape {shape!s:.60}, expected 1 to 8 whole numbers from 1"
        )
    return tuple(map(int, sides))


def _require(name: str, what: str, fits: bool, seen: str, signal: Shape) -> None:
    if not fits:
        raise ExportError(
            f"the NIR node {name!s:.60} has {what} of {seen!s:.80}, which do not fit a signal of {signal}"
        )
