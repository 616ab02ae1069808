"""Limits: how much of a resource a layer needs, and how much of it a chip has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from switchmt_snn.export.chips.rules import RULES, Widths
from switchmt_snn.export.chips.shapes import LayerShape

Per = Literal["layer", "core", "chip"]
Only = Literal["any", "first", "hidden", "last"]


@dataclass(frozen=True)
class Limit:
    """How much of a resource a layer or a network needs of a chip.

    Attributes:
        resource: name of the resource.
        needs, has: amounts in ``unit``; ``has`` is above zero.
    """

    resource: str
    needs: float
    has: float
    unit: str

    @property
    def fits(self) -> bool:
        """Whether the chip has enough."""
        return self.needs <= self.has

    def __str__(self) -> str:
        unit = "" if self.unit in self.resource else f" {self.unit}"
        return f"{self.resource} {self.needs:,.10g} of {self.has:,.10g}{unit}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "fits": self.fits}


@dataclass(frozen=True)
class Resource:
    """A resource of a chip.

    Attributes:
        resource: its name in reports.
        rule: how much a layer needs: a name in ``switchmt_snn.export.chips.rules.RULES``.
        has: how much each layer, each core or the whole chip has (``per``).
        only: the layers that need it; ``hidden`` are all but the last.
        whole_channels: whether an output channel stays on one core if it fits there; else layers are divided evenly.
        source: origin of ``has`` if it is not the chip's source; may be empty.
    """

    resource: str
    rule: str
    has: float
    unit: str
    per: Per = "layer"
    only: Only = "any"
    whole_channels: bool = False
    source: str = ""

    def needs(self, layer: LayerShape, widths: Widths) -> float:
        """Amount that a layer needs."""
        return RULES[self.rule](layer, widths)

    def needed_at(self, index: int, layers: int) -> bool:
        """Whether the layer with this index needs it."""
        return {"any": True, "first": index == 0, "hidden": index < layers - 1, "last": index == layers - 1}[self.only]

    def cores(self, layer: LayerShape, widths: Widths) -> int:
        """Cores that the layer takes for it."""
        needs = self.needs(layer, widths)
        channels = int(self.has * layer.units // needs) if self.whole_channels else 0
        return math.ceil(layer.units / channels) if channels else math.ceil(needs / self.has)
