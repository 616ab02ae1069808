"""Builds ONNX graphs operator by operator: a file is a function of the network alone, and each value has a name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 18
"""Operator set of the files (that of ONNX 1.13)."""
FLOAT, INT32, INT64 = TensorProto.FLOAT, TensorProto.INT32, TensorProto.INT64
TASK = "known_task"
"""The value that operators pick a task's numbers by: the input ``task``, made out of range where it is negative."""


@dataclass
class Graph:
    """Nodes of one graph or subgraph; constants go to the outermost graph."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: dict[str, onnx.TensorProto] = field(default_factory=dict)

    def inner(self) -> Graph:
        """A subgraph, empty, which shares the constants."""
        return Graph([], self.constants)

    def constant(self, name: str, value: npt.ArrayLike, dtype: npt.DTypeLike | None = None) -> str:
        """Store a value under a name, once; returns the name.

        Without a dtype, an array of integers or booleans keeps its own (as axes and indices need), and everything else
        is float32: numbers, lists, float arrays.
        """
        if dtype is None:
            dtype = value.dtype if isinstance(value, np.ndarray) and value.dtype.kind in "iub" else np.float32
        if name not in self.constants:
            self.constants[name] = numpy_helper.from_array(np.asarray(value, dtype), name)
        return name

    def add(self, operator: str, inputs: list[str], *outputs: str, **attributes: Any) -> str:
        """Append an operator, named after its first output unless ``name`` is given; returns that output's name."""
        name = attributes.pop("name", f"{outputs[0]}/{operator}")
        self.nodes.append(helper.make_node(operator, inputs, list(outputs), name=name, **attributes))
        return outputs[0]
