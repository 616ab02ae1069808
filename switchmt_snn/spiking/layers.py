"""The description of a network: one small class per node. Every reader (ONNX, NIR, counting, chips) dispatches on them.

Shapes: O output channels or features.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class NeuronNode:
    """Neurons of one layer. A model's own node adds its parameters.

    A field ending in ``_O`` has one value per output channel.
    """

    @property
    def kind(self) -> str:
        """The model's name in metadata and reports (``IF``, ``LIF``, ``relu``, ...)."""
        raise NotImplementedError(f"{type(self).__name__} has no kind, expected a name")

    def facts(self) -> dict[str, Any]:
        """Plain values of all parameters; one number where all channels share it."""
        facts: dict[str, Any] = {"neuron": self.kind}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = float(value[0]) if (value == value[0]).all() else value.tolist()
            facts[field.name.removesuffix("_O")] = value
        return facts


def side_by_side(nodes: Sequence[NeuronNode]) -> NeuronNode:
    """Neurons of several layers as those of one layer, channel after channel (the streams of a dueling network).

    Raises:
        ExportError: the layers differ in more than per-channel parameters.
    """
    first = nodes[0]
    if any(type(node) is not type(first) for node in nodes):
        kinds = ", ".join(type(node).__name__ for node in nodes)
        raise ExportError(f"layers side by side have neurons {kinds}, expected one kind; use the same neuron in each")
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(first):
        values = [getattr(node, field.name) for node in nodes]
        if field.name.endswith("_O"):
            merged[field.name] = np.concatenate(values)
        elif all(value == values[0] for value in values):
            merged[field.name] = values[0]
        else:
            raise ExportError(f"layers side by side have {field.name} {values}, expected the same value in each")
    return dataclasses.replace(first, **merged)
