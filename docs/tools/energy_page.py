"""The generated parts of docs/energy.md: energy targets, chips and rules, as their files and functions say."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import load_config, resolve
from switchmt_snn.export.chips.chip_file import CHIPS, MAPPINGS
from switchmt_snn.export.chips.fit import check_fit, layer_shapes
from switchmt_snn.export.chips.mappings import CorePerLayer
from switchmt_snn.export.chips.rules import RULES
from switchmt_snn.export.energy.estimate import TARGETS, Target
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.registry import make_suite

PAGE = Path(__file__).parents[1] / "energy.md"


def energy_page() -> str:
    """docs/energy.md with every part between ``<!-- generated: NAME -->`` and ``<!-- end -->`` written anew."""
    parts = {
        "targets": targets_part,
        "not priced": not_priced_part,
        "chips": chips_part,
        "limits": limits_part,
        "rules": rules_part,
        "paper": paper_part,
    }
    written = []

    def write(match: re.Match[str]) -> str:
        written.append(match[1])
        return f"<!-- generated: {match[1]} -->\n\n{parts[match[1]]()}\n\n<!-- end -->"

    page = re.sub(r"<!-- generated: (.+?) -->\n.*?<!-- end -->", write, PAGE.read_text(encoding="utf-8"), flags=re.S)
    if sorted(written) != sorted(parts):
        raise ValueError(f"docs/energy.md has the generated parts {written}, expected {list(parts)}")
    return page


def _table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    lines = [list(header), *(list(row) for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def targets_part() -> str:
    """A row per energy target, and what each includes and leaves out."""
    targets = TARGETS.built_in.values()
    table = _table(
        ("target", "chip", "evidence", "pJ per operation", "source"),
        (
            (f"`{target.name}`", f"{target.chip}, {target.process}", target.evidence, _prices(target), target.source)
            for target in targets
        ),
    )
    scope = [f"- `{target.name}` includes {target.includes}. It leaves out {target.leaves_out}." for target in targets]
    return "\n".join((table, "", *scope))


def _prices(target: Target) -> str:
    prices = ", ".join(f"{name} {price:,.6g}" for name, price in target.operations_pj.items())
    if target.memory is None:
        return prices
    levels = ", ".join(f"{size:g} kB {pj:g}" for size, pj in target.memory.access_pj_by_kilobytes.items())
    return f"{prices}; SRAM per {target.memory.access_bits} bits: {levels}"


def not_priced_part() -> str:
    """The chips of this page that no energy target prices."""
    priced = {target.chip for target in TARGETS.built_in.values()}
    titles = [chip.title for chip in CHIPS.built_in.values() if chip.title not in priced]
    return f"No energy per operation is published for {', '.join(titles)}; none is invented."


def chips_part() -> str:
    """A row per chip."""
    return _table(
        ("chip", "name", "vendor", "first layer takes", "layers", "neurons", "cores", "weights", "source"),
        (
            (
                f"`{chip.name}`",
                chip.title,
                chip.vendor,
                chip.takes,
                ", ".join(chip.layers),
                ", ".join(chip.neurons),
                f"{chip.mapping.num_cores} (`{_mapping_name(chip.mapping)}`)"
                if chip.mapping.num_cores
                else f"`{_mapping_name(chip.mapping)}`",
                f"{chip.widths.weight_bits} bits",
                chip.source,
            )
            for chip in CHIPS.built_in.values()
        ),
    )


def _mapping_name(mapping: object) -> str:
    return next(name for name, (cls, _, _) in MAPPINGS.items() if type(mapping) is cls)


def limits_part() -> str:
    """A row per limit of every chip."""
    rows = []
    for chip in CHIPS.built_in.values():
        if isinstance(chip.mapping, CorePerLayer):
            kinds = dict.fromkeys(chip.mapping.cores)
            words = [f"{chip.mapping.cores.count(k)} of {k.kernels_ki} and {k.neurons_ki}" for k in kinds]
            rows.append((f"`{chip.name}`", "kernel and neuron memory", "", f"{', '.join(words)} Ki", "core", "any", ""))
            strides = ", ".join(map(str, chip.mapping.strides))
            rows.append((f"`{chip.name}`", "strides", "", strides, "layer", "any", ""))
        for one in chip.resources:
            amount = f"{one.has:,.10g} {one.unit}"
            rows.append((f"`{chip.name}`", one.resource, f"`{one.rule}`", amount, one.per, one.only, one.source))
    return _table(("chip", "resource", "rule", "has", "per", "layers", "source, if not the chip's"), rows)


def rules_part() -> str:
    """The rules and mappings that a file can name."""
    rules = _table(("rule", "what one layer needs"), ((f"`{name}`", _text(rule)) for name, rule in RULES.items()))
    mappings = _table(
        ("mapping", "keys", "which cores a layer takes"),
        ((f"`{name}`", ", ".join(keys), _text(cls)) for name, (cls, keys, _) in MAPPINGS.items()),
    )
    return f"{rules}\n\n{mappings}"


def _text(documented: object) -> str:
    """First paragraph of a docstring, without its roles."""
    paragraph = " ".join((documented.__doc__ or "").split("\n\n")[0].split())
    return re.sub(r":\w+:`(.+?)`", r"`\1`", paragraph).replace("``", "`").rstrip(".")


def paper_part() -> str:
    """The paper's network on every chip."""
    config = resolve(load_config("paper"))
    suite = make_suite(config.tasks)
    network = build_network(config.network, observation_spec(suite), 0)
    shapes = layer_shapes(fold_agent(Agent(network, suite, config, torch.device("cpu"), 0)))
    rows = []
    for name in CHIPS.built_in:
        fit = check_fit(shapes, name)
        limits = [(layer.layer, limit) for layer in fit.layers for limit in layer.limits]
        limits += [("whole chip", limit) for limit in fit.limits]
        where, tightest = max(limits, key=lambda pair: pair[1].needs / pair[1].has)
        rows.append((f"`{name}`", "yes" if fit.fits else "no", f"{where}: {tightest}", fit.change))
    return _table(("chip", "fits", "scarcest resource", "what would fit"), rows)
