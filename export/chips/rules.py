"""Rules that a chip's file picks by name: how much of a resource one layer needs.

The set is closed: a file cannot hold a formula. A new rule is a function here, in ``RULES``, with a test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from switchmt_snn.export.chips.shapes import LayerShape


@dataclass(frozen=True)
class Widths:
    """Bits that the chip stores.

    Attributes:
        weight_bits: of one weight.
        state_bits: of one state variable of a neuron; None where the chip's file has no rule that needs it.
    """

    weight_bits: int
    state_bits: int | None


Rule = Callable[[LayerShape, Widths], float]


def inputs(layer: LayerShape, widths: Widths) -> float:
    """Number of input values."""
    return layer.inputs


def neurons(layer: LayerShape, widths: Widths) -> float:
    """Number of neurons; for the head, of its outputs."""
    return layer.neurons


def fan_in(layer: LayerShape, widths: Widths) -> float:
    """Synapses of one neuron."""
    return layer.fan_in


def synapses(layer: LayerShape, widths: Widths) -> float:
    """Connections, each counted: a convolution is unrolled."""
    return layer.synapses


def synapse_memory_kib(layer: LayerShape, widths: Widths) -> float:
    """KiB of weights if every connection stores its own: ``synapses * weight_bits / 8 / 1024``."""
    return layer.synapses * widths.weight_bits / 8 / 1024


def weight_memory_kib(layer: LayerShape, widths: Widths) -> float:
    """KiB of weights, a kernel stored once: ``weights * weight_bits / 8 / 1024``."""
    return layer.weights * widths.weight_bits / 8 / 1024


def weights_and_states_bytes(layer: LayerShape, widths: Widths) -> float:
    """Bytes of weights, a kernel stored once, and of the neurons' state variables (``state_bits`` each)."""
    if widths.state_bits is None:
        raise ValueError("weights_and_states_bytes needs state_bits, expected a number; a chip's file is read with it")
    return math.ceil((layer.weights * widths.weight_bits + layer.neurons * layer.states * widths.state_bits) / 8)


def input_features(layer: LayerShape, widths: Widths) -> float:
    """Channels of the input image; of a flat input, its values."""
    return layer.as_convolution()[0][0]


def output_features(layer: LayerShape, widths: Widths) -> float:
    """Output channels of a convolution, outputs of a dense layer."""
    return layer.units


def input_side(layer: LayerShape, widths: Widths) -> float:
    """Larger side of the input image."""
    return max(layer.as_convolution()[0][1:])


def output_side(layer: LayerShape, widths: Widths) -> float:
    """Larger side of the output image."""
    return max(layer.as_convolution()[1][1:])


def kernel_side(layer: LayerShape, widths: Widths) -> float:
    """Larger side of the kernel; the kernel of a dense layer covers its whole input image."""
    return max(layer.as_convolution()[2])


RULES: dict[str, Rule] = {
    rule.__name__: rule
    for rule in (
        inputs,
        neurons,
        fan_in,
        synapses,
        synapse_memory_kib,
        weight_memory_kib,
        weights_and_states_bytes,
        input_features,
        output_features,
        input_side,
        output_side,
        kernel_side,
    )
}
