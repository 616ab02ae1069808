"""Neuromorphic chips: their public limits, and what a layer needs of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

SPECK_SOURCE = "sinabs 3.1.3, backend/dynapcnn: chips/dynapcnn.py, dynapcnn_layer.py; samna documentation, Speck 2e"
SPECK_CORES_KI = ((16, 64),) * 3 + ((32, 32),) * 2 + ((64, 16),) * 2 + ((16, 16),) * 2
"""(kernel, neuron) memory of each core; bias memory is one per feature."""
SPECK_INPUT_SIDE, SPECK_OUTPUT_SIDE, SPECK_FEATURES, SPECK_KERNEL_SIDE, SPECK_STRIDES = 128, 64, 1024, 16, (1, 2, 4, 8)
LOIHI_1_SOURCE = "Davies et al., IEEE Micro 38(1), 2018 (doi 10.1109/MM.2018.112130359); nengo-loihi 1.1, block.py"
LOIHI_1_CORES, LOIHI_1_NEURONS, LOIHI_1_FAN_IN, LOIHI_1_SYNAPSES_KIB = 128, 1024, 4096, 128
"""All but the first per core, as for the next two chips."""
LOIHI_2_SOURCE = "Intel Technology Brief: Taking Neuromorphic Computing to the Next Level with Loihi 2, 2021"
LOIHI_2_CORES, LOIHI_2_NEURONS, LOIHI_2_SYNAPSES, LOIHI_2_WEIGHTS_KIB = 128, 8192, 120e6 / 128, 192
SPINNAKER2_SOURCE = "SpiNNaker2 datasheet 0.03, 2021; arXiv 2103.08392; arXiv 2401.04491"
SPINNAKER2_PES, PE_SRAM_BYTES, MEMBRANE_BYTES = 152, 128 * 1024, 4
XYLO_SOURCE = "rockpool.ai/devices/xylo-overview"
XYLO_2_SOURCE = f"{XYLO_SOURCE}; fan-in: open-neuromorphic.org/neuromorphic-computing/hardware/xylo-synsense"
XYLO_INPUTS, XYLO_2_HIDDEN, XYLO_2_OUTPUTS, XYLO_2_FAN_IN = 16, 1000, 8, 63
XYLO_3_HIDDEN, XYLO_3_OUTPUTS, XYLO_3_REACH = 992, 32, 128
"""The last: hidden neurons that inputs can reach, and hidden neurons that can reach outputs."""
WEIGHT_BITS = 8


@dataclass(frozen=True)
class LayerShape:
    """What fitting needs of a layer: synapses and the neurons (or Q-values) that they feed.

    Attributes:
        input_shape, output_shape: ``(channels, height, width)`` or ``(features,)``.
        kernel: side of a convolution's kernel; None for a linear layer.
        weights: stored weights; a kernel counts once, however often it is used.
        spiking_input: whether its inputs are spikes.
        input_image: shape of a flat input before it was flattened.
    """

    name: str
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    kernel: int | None
    stride: int
    weights: int
    spiking_input: bool
    input_image: tuple[int, ...] | None = None

    @property
    def units(self) -> int:
        """Output channels of a convolution, outputs of a linear layer."""
        return self.output_shape[0]

    @property
    def neurons(self) -> int:
        """Neurons; for the head, its outputs."""
        return math.prod(self.output_shape)

    @property
    def inputs(self) -> int:
        """Values that come in."""
        return math.prod(self.input_shape)

    @property
    def fan_in(self) -> int:
        """Synapses of one neuron."""
        return self.inputs if self.kernel is None else self.input_shape[0] * self.kernel**2

    @property
    def synapses(self) -> int:
        """Connections, each counted, whether weights are shared or not."""
        return self.neurons * self.fan_in

    def resized(self, units: int, inputs: int | None = None) -> LayerShape:
        """With another number of units and, if it is linear, of inputs."""
        fed = self if inputs is None else replace(self, input_shape=(inputs,), input_image=None)
        return replace(fed, output_shape=(units, *self.output_shape[1:]), weights=units * fed.fan_in)


@dataclass(frozen=True)
class Limit:
    """One limited resource."""

    resource: str
    needs: float
    has: float
    unit: str

    @property
    def fits(self) -> bool:
        """Whether there is enough."""
        return self.needs <= self.has

    def __str__(self) -> str:
        unit = "" if self.unit in self.resource else f" {self.unit}"
        return f"{self.resource} {self.needs:,.10g} of {self.has:,.10g}{unit}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "fits": self.fits}


@dataclass(frozen=True)
class Resource:
    """What a layer needs of a resource, and how much of it there is.

    Attributes:
        has: for each layer, each core, or the chip (``per``).
        place: the layers that need it; ``hidden`` are all but the last.
        whole_channels: whether an output channel stays on one core, if it can; if not, layers are divided evenly.
    """

    resource: str
    needs: Callable[[LayerShape], float]
    has: float
    unit: str
    per: Literal["layer", "core", "chip"] = "layer"
    place: Literal["any", "first", "hidden", "last"] = "any"
    whole_channels: bool = False

    def needed_at(self, index: int, layers: int) -> bool:
        """Whether the layer with this index needs it."""
        return {"any": True, "first": index == 0, "hidden": index < layers - 1, "last": index == layers - 1}[self.place]

    def cores(self, layer: LayerShape) -> int:
        """Cores that the layer takes for it."""
        channels = int(self.has * layer.units // self.needs(layer)) if self.whole_channels else 0
        return math.ceil(layer.units / channels) if channels else math.ceil(self.needs(layer) / self.has)


@dataclass(frozen=True)
class Chip:
    """A chip and its resources.

    Attributes:
        takes_values: whether inputs may be numbers, not only spikes.
        num_cores: a layer takes whole cores; None if all layers share one.
        notes: what the check leaves out or requires.
    """

    name: str
    title: str
    source: str
    takes_values: bool
    num_cores: int | None
    resources: tuple[Resource, ...]
    notes: tuple[str, ...]

    def cores(self, layer: LayerShape) -> int:
        """Cores that a layer takes, at least."""
        return max((resource.cores(layer) for resource in self.resources if resource.per == "core"), default=1)

    def layer_limits(self, layers: Sequence[LayerShape], index: int) -> list[Limit]:
        """Limits of one layer of a network, as if it had the chip for itself."""
        return self._limits({index: layers[index]}, len(layers), ("layer", "core", "chip"))

    def chip_limits(self, layers: Sequence[LayerShape]) -> list[Limit]:
        """Limits of all layers together."""
        return self._limits(dict(enumerate(layers)), len(layers), ("core", "chip"))

    def _limits(self, of: dict[int, LayerShape], layers: int, per: tuple[str, ...]) -> list[Limit]:
        limits = []
        if self.num_cores is not None:
            limits += [Limit("cores", sum(map(self.cores, of.values())), self.num_cores, "cores")]
        for one in self.resources:
            needs = [one.needs(layer) for index, layer in of.items() if one.needed_at(index, layers)]
            if needs and one.per in per:
                has = one.has * (self.num_cores or 1) if one.per == "core" else one.has
                limits += [Limit(one.resource, sum(needs), has, one.unit)]
        return limits


class Speck(Chip):
    """A layer is a convolution on one core, which holds kernels and neurons, both rounded up to powers of two."""

    def layer_limits(self, layers: Sequence[LayerShape], index: int) -> list[Limit]:
        """Memories of the cores, besides."""
        kernel_ki, neuron_ki = speck_memory_ki(layers[index])
        holding = [core for core in SPECK_CORES_KI if kernel_ki <= core[0]] or SPECK_CORES_KI
        sides, stride = as_convolution(layers[index])[2], layers[index].stride
        nearest = stride if stride in SPECK_STRIDES else max(s for s in SPECK_STRIDES if s < stride)
        return [
            Limit("kernel memory of a core", kernel_ki, max(kernel for kernel, _ in SPECK_CORES_KI), "Ki"),
            Limit("neuron memory of a core that holds the kernels", neuron_ki, max(n for _, n in holding), "Ki"),
            *super().layer_limits(layers, index),
            *([] if sides[0] == sides[1] else [Limit("square kernel", max(sides), min(sides), "pixels")]),
            *([] if stride == nearest else [Limit("stride (1, 2, 4 or 8)", stride, nearest, "pixels")]),
        ]

    def chip_limits(self, layers: Sequence[LayerShape]) -> list[Limit]:
        """Whether every layer finds a core of its own that holds it, besides."""
        options = [
            [i for i, (kernel, neuron) in enumerate(SPECK_CORES_KI) if kernel_ki <= kernel and neuron_ki <= neuron]
            for kernel_ki, neuron_ki in map(speck_memory_ki, layers)
        ]
        found = len(assign_cores(options))
        apart = Limit("cores large enough, one per layer", len(layers), found, "cores")
        return [*super().chip_limits(layers), *([apart] if found else [])]


def as_convolution(layer: LayerShape) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, int]]:
    """Input image, output image and kernel sides; the kernel of a linear layer covers its whole input image."""
    image, output = (
        shape if len(shape) == 3 else (math.prod(shape), 1, 1)
        for shape in (layer.input_image or layer.input_shape, layer.output_shape)
    )
    return image, output, (image[1], image[2]) if layer.kernel is None else (layer.kernel, layer.kernel)


def speck_memory_ki(layer: LayerShape) -> tuple[float, float]:
    """Kernels ``c 2^(ceil log2(kh kw) + ceil log2 f)`` and neurons ``f 2^(ceil log2 h + ceil log2 w)`` (sinabs)."""
    image, (features, *sides), kernel = as_convolution(layer)
    height, width, in_kernel, all_features = (2 ** (n - 1).bit_length() for n in (*sides, math.prod(kernel), features))
    return image[0] * in_kernel * all_features / 1024, features * height * width / 1024


def assign_cores(options: Sequence[Sequence[int]]) -> dict[int, int]:
    """As many layers as possible on cores of their own (augmenting paths): core by layer, of those that hold it."""
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


_SPECK = (
    Resource("input features", lambda layer: as_convolution(layer)[0][0], SPECK_FEATURES, "features"),
    Resource("output features", lambda layer: layer.units, SPECK_FEATURES, "features"),
    Resource("input side", lambda layer: max(as_convolution(layer)[0][1:]), SPECK_INPUT_SIDE, "pixels"),
    Resource("output side", lambda layer: max(as_convolution(layer)[1][1:]), SPECK_OUTPUT_SIDE, "pixels"),
    Resource("kernel side", lambda layer: max(as_convolution(layer)[2]), SPECK_KERNEL_SIDE, "pixels"),
)
_LOIHI_1 = (
    Resource("inputs of a neuron", lambda layer: layer.fan_in, LOIHI_1_FAN_IN, "axons"),
    Resource("neurons", lambda layer: layer.neurons, LOIHI_1_NEURONS, "compartments", "core"),
    Resource("synaptic memory", lambda layer: layer.synapses / 1024, LOIHI_1_SYNAPSES_KIB, "KiB", "core"),
)
_LOIHI_2 = (
    Resource("neurons", lambda layer: layer.neurons, LOIHI_2_NEURONS, "neurons", "core"),
    Resource("synapses", lambda layer: layer.synapses, LOIHI_2_SYNAPSES, "synapses", "core"),
    Resource("weight memory", lambda layer: layer.weights / 1024, LOIHI_2_WEIGHTS_KIB, "KiB", "core"),
)
_SPINNAKER2 = (
    Resource("SRAM", lambda of: of.weights + MEMBRANE_BYTES * of.neurons, PE_SRAM_BYTES, "bytes", "core", "any", True),
)
_XYLO_2 = (
    Resource("inputs", lambda layer: layer.inputs, XYLO_INPUTS, "inputs", place="first"),
    Resource("inputs of a neuron", lambda layer: layer.fan_in, XYLO_2_FAN_IN, "synapses", place="hidden"),
    Resource("hidden neurons", lambda layer: layer.neurons, XYLO_2_HIDDEN, "neurons", "chip", "hidden"),
    Resource("outputs", lambda layer: layer.neurons, XYLO_2_OUTPUTS, "neurons", place="last"),
)
_XYLO_3 = (
    Resource("inputs", lambda layer: layer.inputs, XYLO_INPUTS, "inputs", place="first"),
    Resource("neurons that inputs reach", lambda layer: layer.neurons, XYLO_3_REACH, "neurons", place="first"),
    Resource("hidden neurons", lambda layer: layer.neurons, XYLO_3_HIDDEN, "neurons", "chip", "hidden"),
    Resource("neurons that reach outputs", lambda layer: layer.inputs, XYLO_3_REACH, "neurons", place="last"),
    Resource("outputs", lambda layer: layer.neurons, XYLO_3_OUTPUTS, "neurons", place="last"),
)
ONE_TASK = "one task at a time: gains and BatchNorm are in the weights, and another task means loading others"
_SPIKES_OUT = "sends spikes: the head's Q-values are read as spike counts, or a host computes the head"
_SPECK_NOTES = (_SPIKES_OUT, "16-bit membranes without decay: a leak is linear, and biases use it")
_LOIHI_1_NOTES = (
    "a lower bound: synaptic memory counts weights, without index bits, biases and axon tables",
    "every synapse of a convolution is stored; sharing its weights takes less (arXiv 2101.04261)",
    "all neurons of a core together see at most 4096 inputs; of a convolution one neuron is checked",
)
_LOIHI_2_NOTES = (
    "a lower bound: weight memory counts each kernel once, without membranes, code and tables",
    "frames come in as graded spikes; a core has a 128th of the chip's 120 million synapses",
)
_SPINNAKER2_NOTES = (
    "a lower bound: SRAM counts weights and 4-byte membranes, without code, routing tables and spike buffers",
    "the 2 GB of DRAM beside the chip are not counted",
)
_XYLO_NOTES = (_SPIKES_OUT, "convolutions are unrolled", "a neuron's fan-out is not checked")
_CHIPS = (
    Speck("speck", "Speck 2e/2f", SPECK_SOURCE, False, len(SPECK_CORES_KI), _SPECK, _SPECK_NOTES),
    Chip("loihi-1", "Loihi", LOIHI_1_SOURCE, False, LOIHI_1_CORES, _LOIHI_1, _LOIHI_1_NOTES),
    Chip("loihi-2", "Loihi 2", LOIHI_2_SOURCE, True, LOIHI_2_CORES, _LOIHI_2, _LOIHI_2_NOTES),
    Chip("spinnaker2", "SpiNNaker2", SPINNAKER2_SOURCE, True, SPINNAKER2_PES, _SPINNAKER2, _SPINNAKER2_NOTES),
    Chip("xylo-audio-2", "Xylo Audio 2", XYLO_2_SOURCE, False, None, _XYLO_2, _XYLO_NOTES),
    Chip("xylo-audio-3", "Xylo Audio 3", XYLO_SOURCE, False, None, _XYLO_3, _XYLO_NOTES),
)
CHIPS: dict[str, Chip] = {chip.name: chip for chip in _CHIPS}
