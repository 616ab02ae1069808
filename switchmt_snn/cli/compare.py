"""``switchmt-snn compare``: the page of several runs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.cli.report import write_page
from switchmt_snn.errors import ConfigError


@dataclass(frozen=True)
class CompareOptions:
    """Plot runs side by side on one HTML page; seeds of the same settings become one curve with a band."""

    out: Path | None = None
    """Folder to write to. Default: the first run's own."""
    figures: bool = False
    """Also write every figure as SVG, PNG and CSV, to the folder comparison_figures."""
    trust: bool = False
    """Import modules that the runs name, although you did not make them: this runs their code."""
    json: bool = False
    """Print the page's numbers as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(CompareOptions, argv, "compare", CompareOptions())
    options = parse(CompareOptions, rest, "compare", CompareOptions())
    if len(names) < 2:
        seen = names[0] if names else "no RUN"
        raise ConfigError(f"compare got {seen}, expected two runs or more; switchmt-snn report shows one")
    return write_page(list(names), options.out, options.figures, options.json)
