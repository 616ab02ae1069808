"""A chip: what it holds, its resources, and which of its cores a layer takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from switchmt_snn.export.chips.limits import Limit, Resource
from switchmt_snn.export.chips.mappings import Mapping
from switchmt_snn.export.chips.rules import Widths
from switchmt_snn.export.chips.shapes import LayerShape


@dataclass(frozen=True)
class Chip:
    """A chip, as its YAML file describes it (docs/energy.md, "A chip of your own").

    Attributes:
        source: origin of its constants; a resource may name its own.
        takes: whether inputs must be spikes, or may be dense values.
        layers: kinds of layers that it holds (``conv``, ``dense``).
        neurons: kinds of neurons that it holds (``IF``, ``LIF``, ...).
        resources: in the order of reports.
        notes: what the check leaves out or requires.
    """

    name: str
    title: str
    vendor: str
    source: str
    takes: Literal["spikes", "values"]
    layers: tuple[str, ...]
    neurons: tuple[str, ...]
    widths: Widths
    mapping: Mapping
    resources: tuple[Resource, ...]
    notes: tuple[str, ...]

    def not_held(self, layer: LayerShape) -> str:
        """Kind of the layer or of its neurons if the chip does not have it, with those that it has; else empty."""
        missing = []
        if layer.kind not in self.layers:
            missing.append(f"layer kind {layer.kind} ({self.name} has {', '.join(self.layers)})")
        if layer.neuron is not None and layer.neuron not in self.neurons:
            missing.append(f"neuron kind {layer.neuron} ({self.name} has {', '.join(self.neurons)})")
        return "; ".join(missing)

    def cores(self, layer: LayerShape) -> int:
        """Cores that a layer takes, at least."""
        taken = (resource.cores(layer, self.widths) for resource in self.resources if resource.per == "core")
        return max(taken, default=1)

    def layer_limits(self, layers: Sequence[LayerShape], index: int) -> list[Limit]:
        """Limits of one layer of a network, as if it had the chip for itself."""
        resources = self._limits({index: layers[index]}, len(layers), ("layer", "core", "chip"))
        return self.mapping.layer_limits(layers[index], resources)

    def chip_limits(self, layers: Sequence[LayerShape]) -> list[Limit]:
        """Limits of all layers together."""
        return self.mapping.chip_limits(layers, self._limits(dict(enumerate(layers)), len(layers), ("core", "chip")))

    def _limits(self, of: dict[int, LayerShape], layers: int, per: tuple[str, ...]) -> list[Limit]:
        limits, num_cores = [], self.mapping.num_cores
        if num_cores is not None:
            limits.append(Limit("cores", sum(map(self.cores, of.values())), num_cores, "cores"))
        for one in self.resources:
            needs = [one.needs(layer, self.widths) for index, layer in of.items() if one.needed_at(index, layers)]
            if needs and one.per in per:
                has = one.has * (num_cores or 1) if one.per == "core" else one.has
                limits.append(Limit(one.resource, sum(needs), has, one.unit))
        return limits
