"""Will it fit on the chip? Every layer against the chip's public limits, with what the check leaves out.

A "no" names what is short and, if one exists, the largest layer that fits, found by the same check. A "yes" is as good
as what is counted: read ``ChipFit.conditions``.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from itertools import groupby
from typing import Any

from switchmt_snn.errors import ExportError
from switchmt_snn.export.chips.chip import Chip
from switchmt_snn.export.chips.chip_file import CHIPS
from switchmt_snn.export.chips.limits import Limit
from switchmt_snn.export.chips.shapes import LayerShape
from switchmt_snn.spiking.folding import FoldedNetwork
from switchmt_snn.spiking.layers import Conv, Dense, SynapseNode, no_rule

ONE_TASK = "one task at a time: gains and BatchNorm are in the weights, and another task means loading others"


@dataclass(frozen=True)
class LayerFit:
    """One layer, as if it had the chip for itself.

    Attributes:
        cores: number of cores that it takes, at least.
        not_held: kind of layer or of neurons that the chip does not have; empty if it has both.
        change: if it does not fit: the change with which it would (checked), or what forbids every size.
    """

    layer: str
    limits: tuple[Limit, ...]
    cores: int
    not_held: str
    change: str

    @property
    def fits(self) -> bool:
        """Whether the chip has its kinds, and enough of every resource."""
        return not self.not_held and all(limit.fits for limit in self.limits)

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
        conditions: what else must be true, and what is not counted.
        host: layers that see dense values although the chip takes spikes only; their resources are counted, too.
        change: if it does not fit: the number of hidden units with which everything does (checked); empty if no
            number does.
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
    """Shapes of all layers, the head last; the two streams of a dueling network are layers of their own.

    A chip holds one task's head.

    This is the only function of this package that reads a network's description for its shapes.

    Raises:
        ExportError: a kernel is not square, or has padding.
    """
    shapes: list[LayerShape] = []
    network = network.of_task(0)
    sees_spikes, sees = network.sees_spikes, network.encoded_shape
    for node, neurons in zip(network.synapses, [*(layer.neurons for layer in network.layers), None], strict=True):
        shapes += [
            replace(
                shape,
                spiking_input=sees_spikes,
                input_image=sees if len(sees) == 3 else None,
                neuron=None if neurons is None else neurons.kind,
                states=1 if neurons is None else len(neurons.states),  # the head keeps its sums
            )
            for shape in _shapes(node)
        ]
        sees_spikes, sees = network.spiking, node.output_shape
    return tuple(shapes)


@singledispatch
def _shapes(node: SynapseNode) -> list[LayerShape]:
    """Shapes of a node's layers, on inputs that are values, before any neurons."""
    raise no_rule("the fit of chips", node, _shapes.registry, "add a rule to export/chips/fit.py")


@_shapes.register
def _(node: Conv) -> list[LayerShape]:
    stride, kernel = node.stride, node.weight.shape[2:]
    if stride[0] != stride[1] or kernel[0] != kernel[1] or node.padding != (0, 0):
        raise ExportError(
            f"{node.name} has a kernel of {kernel[0]} x {kernel[1]}, stride {stride} and padding {node.padding}, "
            "expected square ones without padding for chips"
        )
    return [
        LayerShape(
            name=node.name,
            input_shape=node.input_shape,
            output_shape=node.output_shape,
            kernel=kernel[0],
            stride=stride[0],
            weights=node.weight.size,
            spiking_input=False,
            neuron=None,
        )
    ]


@_shapes.register
def _(node: Dense) -> list[LayerShape]:
    streams = ("/value", "/advantage") if node.groups == 2 else ("",)
    return [
        LayerShape(
            name=node.name + stream,
            input_shape=node.input_shape,
            output_shape=(node.output_shape[0] // len(streams),),
            kernel=None,
            stride=1,
            weights=node.weight.size // len(streams),
            spiking_input=False,
            neuron=None,
        )
        for stream in streams
    ]


def check_fit(layers: Sequence[LayerShape], chip: Chip | str) -> ChipFit:
    """Check a network, as ``layer_shapes`` gives it, against a chip.

    Args:
        layers: in forward order, the head last.
        chip: a chip, the name of a built-in one, or a YAML file.

    Raises:
        ConfigError: no such chip, or a file that is not one.

    Examples:
        >>> from switchmt_snn.export.folded import fold_agent
        >>> from switchmt_snn.runs.trained import load_agent
        >>> layers = layer_shapes(fold_agent(load_agent("runs/mine")))
        >>> check_fit(layers, "loihi-1").fits
        True
    """
    on = chip if isinstance(chip, Chip) else CHIPS.load(chip)
    fits = [
        LayerFit(
            layer=layer.name,
            limits=tuple(on.layer_limits(layers, index)),
            cores=on.cores(layer),
            not_held=on.not_held(layer),
            change=_layer_change(on, layers, index),
        )
        for index, layer in enumerate(layers)
    ]
    host = tuple(layer.name for layer in layers if not layer.spiking_input and on.takes == "spikes")
    spikes_in = f"takes spikes only: a host must compute {', '.join(host)} (counted all the same) and send spikes"
    conditions = (*([spikes_in] if host else []), ONE_TASK, *on.notes)
    whole = tuple(on.chip_limits(layers))
    return ChipFit(
        chip=on.name,
        title=on.title,
        source=on.source,
        layers=tuple(fits),
        limits=whole,
        conditions=conditions,
        host=host,
        weight_bits=on.widths.weight_bits,
        change=_chip_change(on, layers),
    )


def _short(chip: Chip, layers: Sequence[LayerShape], index: int) -> list[Limit]:
    return [limit for limit in chip.layer_limits(layers, index) if not limit.fits]


def _layer_change(chip: Chip, layers: Sequence[LayerShape], index: int) -> str:
    """What the chip does not have, or the largest number of units that fits on the same inputs; empty if it fits."""
    if not_held := chip.not_held(layers[index]):
        return f"not held: {not_held}"

    def short(units: int) -> list[Limit]:
        return _short(chip, (*layers[:index], layers[index].resized(units), *layers[index + 1 :]), index)

    most = _largest(layers[index].units, lambda units: not short(units))
    what = "units" if layers[index].kernel is None else "output channels"
    if most == 0:
        return f"fits with no number of {what}: {'; '.join(map(str, short(1)))}"
    return f"fits with at most {most:,} {what} on these inputs (checked)" if most < layers[index].units else ""


def _chip_change(chip: Chip, layers: Sequence[LayerShape]) -> str:
    """The largest number of hidden units with which a network that does not fit would; empty if there is none."""
    units = max((layer.units for layer in layers[:-1] if layer.kernel is None), default=0)
    most = 0 if _fits(chip, layers) else _largest(units, lambda fewer: _fits(chip, _with_hidden_units(layers, fewer)))
    return f"everything fits with network.hidden_units of at most {most:,} (checked)" if most else ""


def _fits(chip: Chip, layers: Sequence[LayerShape]) -> bool:
    alone = not any(chip.not_held(layer) or _short(chip, layers, index) for index, layer in enumerate(layers))
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
