"""``switchmt-snn compare``: the page of several runs side by side."""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.cli.report import ReportOptions, write_page
from switchmt_snn.errors import ConfigError


@dataclass(frozen=True)
class CompareOptions(ReportOptions):
    """Plot runs side by side on one HTML page; seeds of the same settings become one curve with a band."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(CompareOptions, argv, "compare", CompareOptions())
    options = parse(CompareOptions, rest, "compare", CompareOptions())
    if len(names) < 2:
        seen = names[0] if names else "no RUN"
        raise ConfigError(f"compare got {seen}, expected two runs or more; switchmt-snn report shows one")
    return write_page(list(names), options)
