"""Will it fit on the chip? Every layer against the limits that are public, with what the check leaves out.

A "no" names what is short and, where there is one, the largest layer that fits, found by the same check. A "yes" is as
good as what is counted: read :attr:`ChipFit.conditions`.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from switchmt_snn.errors import ConfigError, did_you_mean
from switchmt_snn.export.chips.limits import CHIPS, ONE_TASK, WEIGHT_BITS, Chip, LayerShape, Limit
from switchmt_snn.export.folding import FoldedNetwork


@dataclass(frozen=True)
class LayerFit:
    """One layer, as if it had the chip for itself: its limits, the cores it takes at least, and, where it does not
    fit, the change with which it would (checked) or what forbids every size."""

    layer: str
    limits: tuple[Limit, ...]
    cores: int
    change: str

    @property
    def fits(self) -> bool:
        """Whether every resource suffices."""
        return all(limit.fits for limit in self.limits)

    @property
    def limiting(self) -> Limit:
        """The scarcest resource."""
        return max(self.limits, key=lambda limit: limit.needs / limit.has)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, with the name of the scarcest resource."""
        limits = [limit.to_dict() for limit in self.limits]
        return {**vars(self), "fits": self.fits, "limiting": self.limiting.resource, "limits": limits}


@dataclass(frozen=True)
class ChipFit:
    """All layers together on one chip.

    Attributes:
        limits: of the whole chip.
        conditions: what must hold besides, and what is not counted.
        host: layers that see numbers, which the chip does not take; counted all the same.
        change: where it does not fit: the number of hidden units with which everything does, checked; or nothing.
    """

    chip: str
    title: str
    source: str
    layers: tuple[LayerFit, ...]
    limits: tuple[Limit, ...]
    conditions: tuple[str, ...]
    host: tuple[str, ...]
    weight_bits: int
    change: str

    @property
    def fits(self) -> bool:
        """Whether everything that is counted fits."""
        return all(layer.fits for layer in self.layers) and all(limit.fits for limit in self.limits)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        layers, limits = ([part.to_dict() for part in parts] for parts in (self.layers, self.limits))
        plain = {
            "fits": self.fits,
            "layers": layers,
            "limits": limits,
            "conditions": list(self.conditions),
            "host": list(self.host),
        }
        return {**vars(self), **plain}


def layer_shapes(network: FoldedNetwork) -> tuple[LayerShape, ...]:
    """Shapes of all layers, the head last; the two streams of a dueling network are layers of their own."""
    sees_spikes, shapes = network.sees_spikes, []
    sees = network.encoded_shape
    for layer in network.layers:
        streams = ("/value", "/advantage") if layer.groups == 2 else ("",)
        shapes += [
            LayerShape(
                name=layer.name + stream,
                input_shape=layer.input_shape,
                output_shape=(layer.output_shape[0] // len(streams), *layer.output_shape[1:]),
                kernel=layer.weight.shape[2] if layer.is_convolution else None,
                stride=layer.stride or 1,
                weights=layer.weight.size // len(streams),
                spiking_input=sees_spikes,
                input_image=sees if len(sees) == 3 else None,
            )
            for stream in streams
        ]
        sees_spikes, sees = network.spiking, layer.output_shape
    return tuple(shapes)


def check_fit(layers: Sequence[LayerShape], chip: str) -> ChipFit:
    """Check a network, as :func:`layer_shapes` gives it, against the chip of that name in :data:`CHIPS`.

    Raises:
        ConfigError: no such chip.
    """
    if chip not in CHIPS:
        raise ConfigError(f"unknown chip {chip!r}{did_you_mean(chip, CHIPS)}")
    on = CHIPS[chip]
    fits = [
        LayerFit(layer.name, tuple(on.layer_limits(layers, index)), on.cores(layer), _layer_change(on, layers, index))
        for index, layer in enumerate(layers)
    ]
    host = tuple(layer.name for layer in layers if not layer.spiking_input and not on.takes_values)
    spikes_in = f"takes spikes only: a host must compute {', '.join(host)} (counted all the same) and send spikes"
    conditions = (*([spikes_in] if host else []), ONE_TASK, *on.notes)
    whole = tuple(on.chip_limits(layers))
    return ChipFit(
        on.name, on.title, on.source, tuple(fits), whole, conditions, host, WEIGHT_BITS, _chip_change(on, layers)
    )


def _short(chip: Chip, layers: Sequence[LayerShape], index: int) -> list[Limit]:
    return [limit for limit in chip.layer_limits(layers, index) if not limit.fits]


def _layer_change(chip: Chip, layers: Sequence[LayerShape], index: int) -> str:
    """The largest number of units with which a layer that does not fit would, on the same inputs."""

    def short(units: int) -> list[Limit]:
        return _short(chip, (*layers[:index], layers[index].resized(units), *layers[index + 1 :]), index)

    most = _largest(layers[index].units, lambda units: not short(units))
    what = "units" if layers[index].kernel is None else "output channels"
    if most == 0:
        return f"fits with no number of {what}: {'; '.join(map(str, short(1)))}"
    return f"fits with at most {most:,} {what} on these inputs (checked)" if most < layers[index].units else ""


def _chip_change(chip: Chip, layers: Sequence[LayerShape]) -> str:
    """The largest number of hidden units with which a network that does not fit would."""
    units = max((layer.units for layer in layers[:-1] if layer.kernel is None), default=0)
    most = 0 if _fits(chip, layers) else _largest(units, lambda fewer: _fits(chip, _with_hidden_units(layers, fewer)))
    return f"everything fits with network.hidden_units of at most {most:,} (checked)" if most else ""


def _fits(chip: Chip, layers: Sequence[LayerShape]) -> bool:
    alone = not any(_short(chip, layers, index) for index in range(len(layers)))
    return alone and all(limit.fits for limit in chip.chip_limits(layers))


def _largest(up_to: int, fits: Callable[[int], bool]) -> int:
    """The largest size from 1 to ``up_to`` that fits, or 0; with a size every smaller one fits."""
    return bisect.bisect_left(range(1, up_to + 1), True, key=lambda size: not fits(size))


def _with_hidden_units(layers: Sequence[LayerShape], units: int) -> list[LayerShape]:
    """The network with that many units in every linear layer (or stream of one) but the head."""
    changed: list[LayerShape] = []
    inputs = None
    for _, group in groupby(layers, key=lambda layer: layer.name.split("/")[0]):
        streams = list(group)
        resized = streams[0].kernel is None and len(changed) + len(streams) < len(layers)
        changed += [stream.resized(units if resized else stream.units, inputs) for stream in streams]
        inputs = units * len(streams) if resized else None
    return changed
