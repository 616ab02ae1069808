"""Mapping rules that a chip's file picks by name: which cores a layer takes. The set is closed, as that of the rules.

- ``WholeCores``: layers are divided among equal cores; no core holds two layers.
- ``SharedCore``: all layers share one core.
- ``CorePerLayer``: every layer is a convolution on one core of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from switchmt_snn.export.chips.limits import Limit
from switchmt_snn.export.chips.shapes import LayerShape


class Mapping:
    """Base of the mapping rules: cores, and limits that follow from them."""

    @property
    def num_cores(self) -> int | None:
        """Number of cores; None where they are not counted."""
        raise NotImplementedError(
            f"{type(self).__name__} defines no num_cores, expected a property with the number of cores, or None where "
            "they are not counted"
        )

    def layer_limits(self, layer: LayerShape, resources: list[Limit]) -> list[Limit]:
        """Limits of one layer: those of the chip's ``resources``, and those of the mapping."""
        return resources

    def chip_limits(self, layers: Sequence[LayerShape], resources: list[Limit]) -> list[Limit]:
        """Limits of all layers together."""
        return resources


@dataclass(frozen=True)
class WholeCores(Mapping):
    """Equal cores; a layer takes as many whole ones as its scarcest resource ``per: core`` asks for."""

    cores: int

    @property
    def num_cores(self) -> int | None:
        """Number of cores."""
        return self.cores


@dataclass(frozen=True)
class SharedCore(Mapping):
    """All layers share one core; its resources are ``per: layer`` or ``per: chip``."""

    @property
    def num_cores(self) -> int | None:
        """None."""
        return None


@dataclass(frozen=True)
class ConvolutionCore:
    """Memory of one core, in Ki words (1,024 weights or membranes)."""

    kernels_ki: int
    neurons_ki: int

    def holds(self, kernels_ki: float, neurons_ki: float) -> bool:
        """Whether a layer with these needs fits."""
        return kernels_ki <= self.kernels_ki and neurons_ki <= self.neurons_ki


@dataclass(frozen=True)
class CorePerLayer(Mapping):
    """Every layer takes one core that holds its kernels and its neurons, both rounded up to powers of two
    (``convolution_memory_ki``); kernels are square, and strides are listed.

    Attributes:
        cores: in the chip's order; they may differ.
        strides: ascending, the first is 1.
    """

    cores: tuple[ConvolutionCore, ...]
    strides: tuple[int, ...]

    @property
    def num_cores(self) -> int | None:
        """Number of cores."""
        return len(self.cores)

    def layer_limits(self, layer: LayerShape, resources: list[Limit]) -> list[Limit]:
        """Memories of the cores, ``resources``, and what the cores cannot compute: other kernels and strides."""
        kernels, neurons = convolution_memory_ki(layer)
        holding = [core for core in self.cores if kernels <= core.kernels_ki] or self.cores
        most_kernels = max(core.kernels_ki for core in self.cores)
        most_neurons = max(core.neurons_ki for core in holding)
        sides = layer.as_convolution()[2]
        nearest = max(stride for stride in self.strides if stride <= layer.stride)
        listed = " or ".join(filter(None, (", ".join(map(str, self.strides[:-1])), str(self.strides[-1]))))
        return [
            Limit("kernel memory of a core", kernels, most_kernels, "Ki"),
            Limit("neuron memory of a core that holds the kernels", neurons, most_neurons, "Ki"),
            *resources,
            *([] if sides[0] == sides[1] else [Limit("square kernel", max(sides), min(sides), "pixels")]),
            *([] if layer.stride == nearest else [Limit(f"stride ({listed})", layer.stride, nearest, "pixels")]),
        ]

    def chip_limits(self, layers: Sequence[LayerShape], resources: list[Limit]) -> list[Limit]:
        """``resources``, and whether every layer finds a core of its own that holds it."""
        needs = [convolution_memory_ki(layer) for layer in layers]
        options = [[i for i, core in enumerate(self.cores) if core.holds(*memory)] for memory in needs]
        found = len(assign_cores(options))
        placed = [Limit("cores large enough, one per layer", len(layers), found, "cores")] if found else []
        return [*resources, *placed]


def convolution_memory_ki(layer: LayerShape) -> tuple[float, float]:
    """Ki words of kernels and of neurons on a core of DYNAP-CNN and Speck.

    Kernels ``c 2^(ceil log2(kh kw) + ceil log2 f)``, neurons ``f 2^(ceil log2 h + ceil log2 w)`` for c input channels,
    f output channels, a kernel of kh x kw and an output of h x w (sinabs, ``dynapcnn_layer.py``).
    """
    image, (features, *sides), kernel = layer.as_convolution()
    height, width, in_kernel, all_features = (2 ** (n - 1).bit_length() for n in (*sides, math.prod(kernel), features))
    return image[0] * in_kernel * all_features / 1024, features * height * width / 1024


def assign_cores(options: Sequence[Sequence[int]]) -> dict[int, int]:
    """Place as many layers as possible, each on a core of its own (augmenting paths).

    Args:
        options: for each layer the cores that hold it.

    Returns:
        Core by layer.
    """
    layer_on: dict[int, int] = {}

    def place(layer: int, tried: set[int]) -> bool:
        for core in options[layer]:
            if core not in tried:
                tried.add(core)
                if core not in layer_on or place(layer_on[core], tried):
                    layer_on[core] = layer
                    return True
        return False

    for layer in range(len(options)):
        place(layer, set())
    return {layer: core for core, layer in layer_on.items()}
