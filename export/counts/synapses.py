"""Exact counts of operations: NeuroBench's definitions, in integers.

A synaptic operation is a non-zero input that meets a non-zero weight inside the image; padding is not counted. Dense
operations count every input and weight. A layer whose inputs are spikes accumulates (AC), any other one multiplies and
accumulates (MAC); that is a property of the layer, never of a batch (NeuroBench 2.3 decides by the values of a batch).

Because what an input can reach depends on its position only, a count is a sum over the active inputs of their fan-out,
an integer array made once per layer. Nothing is added up in float32.

Shapes: T simulation steps, B batch (decisions), O output and I input channels or features, ... a layer's own shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import numpy.typing as npt

from switchmt_snn.spiking.layers import Conv, Dense, SynapseNode, no_rule

Int = npt.NDArray[np.int64]

RATE_BINS = 20
"""Ranges of firing rates that a distribution is told in."""
_REMEDY = "add a rule to export/counts/synapses.py"


@dataclass(frozen=True)
class CountedSynapses:
    """Synapses and what comes in.

    Attributes:
        node: the synapses.
        spiking_input: whether inputs are spikes.
    """

    node: SynapseNode
    spiking_input: bool

    @property
    def operation(self) -> str:
        """``AC`` or ``MAC``."""
        return "AC" if self.spiking_input else "MAC"

    @property
    def shares_weights(self) -> bool:
        """Whether a weight is used at several positions (a convolution)."""
        return shares_weights(self.node)

    def fan_out(self) -> Int:
        """Non-zero weights that each input meets, of the input's shape."""
        return _fan_out(self.node, (self.node.weight != 0).astype(np.int64))

    def dense_operations(self) -> int:
        """Operations of one pass with every input and every weight counted."""
        return self.node.dense_operations


@singledispatch
def shares_weights(node: SynapseNode) -> bool:
    """Whether a weight is used at several positions."""
    raise no_rule("the counter", node, shares_weights.registry, _REMEDY)


@shares_weights.register
def _(node: Conv) -> bool:
    return True


@shares_weights.register
def _(node: Dense) -> bool:
    return False


@singledispatch
def _fan_out(node: SynapseNode, present: Int) -> Int:
    """How many of the weights that are present each input meets; ``present`` is 0 or 1, of the weight's shape."""
    raise no_rule("the counter", node, _fan_out.registry, _REMEDY)


@_fan_out.register
def _(node: Dense, present: Int) -> Int:
    reached_I: Int = present.sum(axis=0)
    return reached_I


@_fan_out.register
def _(node: Conv, present: Int) -> Int:
    _, height, width = node.input_shape
    kernel_Ikk = present.sum(axis=0)
    _, kh, kw = kernel_Ikk.shape
    (sy, sx), (py, px) = node.stride, node.padding
    reached = np.zeros((len(kernel_Ikk), height + 2 * py, width + 2 * px), np.int64)
    for y in range(0, height + 2 * py - kh + 1, sy):
        for x in range(0, width + 2 * px - kw + 1, sx):
            reached[:, y : y + kh, x : x + kw] += kernel_Ikk
    return reached[:, py : py + height, px : px + width]


class SynapseCounter:
    """Adds up the operations of one layer over decisions; its memory does not grow with their number.

    Attributes:
        operations_T: effective operations at each simulation step.
        active_inputs_T: non-zero inputs at each simulation step.
        decisions: decisions seen.
    """

    def __init__(self, synapses: CountedSynapses) -> None:
        self.synapses = synapses
        self.fan_out = synapses.fan_out().reshape(-1)
        self.operations_T: Int = np.zeros(0, np.int64)
        self.active_inputs_T: Int = np.zeros(0, np.int64)
        self.decisions = 0

    def add(self, active_TB: npt.NDArray[np.bool_]) -> None:
        """Count a batch: which inputs ``[T, B, ...]`` are not zero."""
        flat = active_TB.reshape(*active_TB.shape[:2], -1)
        reached_TN = flat.sum(axis=1, dtype=np.int64)  # how often each input was active
        if len(self.operations_T) == 0:
            self.operations_T = np.zeros(len(flat), np.int64)
            self.active_inputs_T = np.zeros(len(flat), np.int64)
        self.operations_T += reached_TN @ self.fan_out
        self.active_inputs_T += reached_TN.sum(axis=1)
        self.decisions += flat.shape[1]


class NeuronCounter:
    """Adds up the spikes of one neuron layer over decisions.

    Attributes:
        spikes_TN: how often each neuron fired at each step.
        decisions: decisions seen.
    """

    def __init__(self, name: str, shape: tuple[int, ...], timesteps: int) -> None:
        self.name, self.shape = name, shape
        self.spikes_TN: Int = np.zeros((timesteps, int(np.prod(shape))), np.int64)
        self.decisions = 0

    def add(self, spikes_TB: npt.NDArray[np.bool_]) -> None:
        """Count a batch of spikes ``[T, B, ...]``."""
        flat = spikes_TB.reshape(*spikes_TB.shape[:2], -1)
        self.spikes_TN += flat.sum(axis=1, dtype=np.int64)
        self.decisions += flat.shape[1]

    @property
    def rate_N(self) -> npt.NDArray[np.float64]:
        """Spikes per neuron and simulation step."""
        rates: npt.NDArray[np.float64] = self.spikes_TN.sum(axis=0) / max(1, self.decisions * len(self.spikes_TN))
        return rates

    @property
    def rate_histogram(self) -> tuple[int, ...]:
        """Number of neurons that fire in each of ``RATE_BINS`` equal ranges of spikes per step.

        A rate on the edge of two ranges belongs to the upper one, and 1 to the last: counted in integers, as a rate
        like 0.15 has no exact float.
        """
        spikes_N, steps = self.spikes_TN.sum(axis=0), max(1, self.decisions * len(self.spikes_TN))
        bins_N = np.minimum(spikes_N[spikes_N > 0] * RATE_BINS // steps, RATE_BINS - 1)
        return tuple(np.bincount(bins_N, minlength=RATE_BINS).tolist())

    @property
    def silent(self) -> int:
        """Neurons that never fired."""
        return int((self.spikes_TN.sum(axis=0) == 0).sum())

    @property
    def saturated(self) -> int:
        """Neurons that fired at every step of every decision."""
        return int((self.spikes_TN.sum(axis=0) == self.decisions * len(self.spikes_TN)).sum())
