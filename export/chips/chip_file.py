"""Chips as YAML files: the built-in ones in ``export/chips/builtin/``, and files of one's own.

docs/energy.md ("A chip of your own") explains every key.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast, get_args

from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import ConfigError, nearest
from switchmt_snn.export.chips.chip import Chip
from switchmt_snn.export.chips.limits import Only, Per, Resource
from switchmt_snn.export.chips.mappings import ConvolutionCore, CorePerLayer, Mapping, SharedCore, WholeCores
from switchmt_snn.export.chips.rules import RULES, Widths
from switchmt_snn.export.chips.shapes import LAYER_KINDS
from switchmt_snn.export.yaml_files import Catalog, Section
from switchmt_snn.spiking.neurons import NEURONS

_TEXTS = ("name", "title", "vendor", "source")
_NEEDED = (*_TEXTS, "takes", "layers", "neurons", "weight_bits", "mapping", "limits")
_OPTIONAL = ("kind", "state_bits", "notes")
_OF_LIMIT = ("per", "only", "whole_channels", "source")


def read_chip(raw: Any, where: str) -> Chip:
    """A chip from the keys and values of its file.

    Raises:
        ConfigError: a key is missing, unknown or of the wrong type, or two of them contradict each other.
    """
    file = Section(where, raw, "", _NEEDED, _OPTIONAL)
    if "kind" in file:
        file.choice("kind", ("chip",))
    mapping = _mapping(file)
    limits = file.section("limits", optional=None)
    if not limits.raw:
        raise file.wrong("limits", "at least one limit")
    for resource in limits.raw:
        if not isinstance(resource, str):
            raise ConfigError(f"{where}: limits has the key {resource!r:.40}, expected the name of a resource")
    state_bits = file.whole("state_bits", 1, 64, "bits") if "state_bits" in file else None
    name, title, vendor, source = (file.text(key, "; every constant needs its origin") for key in _TEXTS)
    file.short_name("name")
    return Chip(
        name=name,
        title=title,
        vendor=vendor,
        source=source,
        takes=cast(Any, file.choice("takes", ("spikes", "values"))),
        layers=file.texts("layers", LAYER_KINDS),
        neurons=_neurons(file),
        widths=Widths(file.whole("weight_bits", 2, 32, "bits"), state_bits),
        mapping=mapping,
        resources=tuple(_resource(limits, resource, mapping, state_bits) for resource in limits.raw),
        notes=file.texts("notes", empty=True) if "notes" in file else (),
    )


def _neurons(file: Section) -> tuple[str, ...]:
    kinds = file.texts("neurons")
    for kind in kinds:
        if kind not in NEURONS and not is_plugin(kind):
            raise ConfigError(
                f"{file.where}: neurons has {kind!r:.80}, expected {', '.join(NEURONS)}, or a neuron of your own as "
                f"module:Class{nearest(kind[:80], NEURONS)}"
            )
    return kinds


def _resource(limits: Section, resource: str, mapping: Mapping, state_bits: int | None) -> Resource:
    limit = limits.section(resource, ("rule", "has", "unit"), _OF_LIMIT)
    rule = limit.choice("rule", tuple(RULES))
    per = limit.choice("per", get_args(Per)) if "per" in limit else "layer"
    whole_channels = limit.flag("whole_channels") if "whole_channels" in limit else False
    if limit.number("has") == 0:
        raise limit.wrong("has", "more than 0")
    if rule == "weights_and_states_bytes" and state_bits is None:
        raise limit.wrong("rule", "state_bits in the file with it")
    if per == "core" and not isinstance(mapping, WholeCores):
        raise limit.wrong("per", "layer or chip: only the mapping whole_cores divides a layer among cores")
    if whole_channels and per != "core":
        raise limit.wrong("whole_channels", "per: core with it")
    return Resource(
        resource=resource,
        rule=rule,
        has=limit.number("has"),
        unit=limit.text("unit"),
        per=cast(Per, per),
        only=cast(Only, limit.choice("only", get_args(Only))) if "only" in limit else "any",
        whole_channels=whole_channels,
        source=limit.text("source") if "source" in limit else "",
    )


def _whole_cores(mapping: Section) -> Mapping:
    return WholeCores(mapping.whole("cores", of="cores"))


def _core_per_layer(mapping: Section) -> Mapping:
    cores: list[ConvolutionCore] = []
    for kind in mapping.sections("cores", ("count", "kernels_ki", "neurons_ki")):
        core = ConvolutionCore(kind.whole("kernels_ki", of="Ki"), kind.whole("neurons_ki", of="Ki"))
        cores += [core] * kind.whole("count", 1, 100_000, "cores")
    strides = mapping.raw["strides"]
    whole = isinstance(strides, list) and all(type(stride) is int for stride in strides)
    if not whole or strides[:1] != [1] or strides != sorted(set(strides)):
        raise mapping.wrong("strides", "a list of ascending whole numbers that begins with 1")
    return CorePerLayer(tuple(cores), tuple(strides))


MAPPINGS: dict[str, tuple[type[Mapping], tuple[str, ...], Callable[[Section], Mapping]]] = {
    "whole_cores": (WholeCores, ("cores",), _whole_cores),
    "shared_core": (SharedCore, (), lambda mapping: SharedCore()),
    "core_per_layer": (CorePerLayer, ("cores", "strides"), _core_per_layer),
}
"""By name: the mapping, the keys that it needs in a file, and how it is read."""


def _mapping(file: Section) -> Mapping:
    every = ("cores", "strides")
    rule = file.section("mapping", ("rule",), every).choice("rule", tuple(MAPPINGS))
    _, needed, read = MAPPINGS[rule]
    return read(file.section("mapping", ("rule", *needed)))


CHIPS = Catalog("chip", "switchmt_snn.export.chips.builtin", read_chip)
"""The chips that come with the package, and files of chips."""
