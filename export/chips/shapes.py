"""What a chip's rules may ask of a layer: its shape, its weights and the kind of its neurons."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

LAYER_KINDS = ("conv", "dense")


@dataclass(frozen=True)
class LayerShape:
    """Synapses, and the neurons (or Q-values) that they feed.

    Attributes:
        input_shape, output_shape: ``(channels, height, width)`` or ``(features,)``.
        kernel: side of a convolution's kernel; None for a dense layer.
        weights: stored weights; a kernel counts once, however often it is used.
        spiking_input: whether its inputs are spikes.
        neuron: kind of its neurons (``LIF``, ...); None for the head, which has none.
        input_image: shape of a flat input before it was flattened.
        states: state variables of one neuron (its membrane, and what else it keeps from step to step).
    """

    name: str
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    kernel: int | None
    stride: int
    weights: int
    spiking_input: bool
    neuron: str | None
    input_image: tuple[int, ...] | None = None
    states: int = 1

    @property
    def kind(self) -> str:
        """One of ``LAYER_KINDS``."""
        return "dense" if self.kernel is None else "conv"

    @property
    def units(self) -> int:
        """Output channels of a convolution, outputs of a dense layer."""
        return self.output_shape[0]

    @property
    def neurons(self) -> int:
        """Number of neurons; for the head, of its outputs."""
        return math.prod(self.output_shape)

    @property
    def inputs(self) -> int:
        """Number of input values."""
        return math.prod(self.input_shape)

    @property
    def fan_in(self) -> int:
        """Synapses of one neuron."""
        return self.inputs if self.kernel is None else self.input_shape[0] * self.kernel**2

    @property
    def synapses(self) -> int:
        """Connections, each counted, whether weights are shared or not."""
        return self.neurons * self.fan_in

    def as_convolution(self) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, int]]:
        """Input image, output image and kernel sides; the kernel of a dense layer covers its whole input image."""
        image, output = (
            shape if len(shape) == 3 else (math.prod(shape), 1, 1)
            for shape in (self.input_image or self.input_shape, self.output_shape)
        )
        return image, output, (image[1], image[2]) if self.kernel is None else (self.kernel, self.kernel)

    def resized(self, units: int, inputs: int | None = None) -> LayerShape:
        """The layer with another number of units and, if it is dense, of inputs."""
        fed = self if inputs is None else replace(self, input_shape=(inputs,), input_image=None)
        return replace(fed, output_shape=(units, *self.output_shape[1:]), weights=units * fed.fan_in)
