"""``switchmt-snn report``: the page of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.errors import ConfigError
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class ReportOptions:
    """Plot a run on one HTML page: curves, switches, speed, layers, scores."""

    out: Path | None = None
    """Folder to write to. Default: the run's own."""
    figures: bool = False
    """Also write every figure as SVG, PNG and CSV, to the folder figures."""
    trust: bool = False
    """Import modules that the run names, although you did not make it: this runs their code."""
    json: bool = False
    """Print the page's numbers as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(ReportOptions, argv, "report", ReportOptions())
    options = parse(ReportOptions, rest, "report", ReportOptions())
    if len(names) > 1:
        raise ConfigError(
            f"report got {len(names)} runs, expected one; switchmt-snn compare shows several side by side"
        )
    return write_page([names[0] if names else None], options.out, options.figures, options.json)


def write_page(names: list[str | None], out: Path | None, figures: bool, json: bool) -> int:
    """Write the page of runs, and say where it is; None is the newest run."""
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.viewing.progress_bar import ProgressBars
    from switchmt_snn.viewing.report.page import write_report

    found = [open_run(name).path for name in names]
    runs = [open_run(path, to_write=True).path for path in found]
    with ProgressBars():
        page = write_report(runs, out, figures)
    if json:
        output.print_json(page.with_suffix(".json").read_text("utf-8"))
    else:
        print(page)
    return 0
