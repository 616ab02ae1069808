"""``switchmt-snn report``: the page of a run, or of several runs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class ReportOptions:
    """Plot a run on one HTML page (curves, switches, speed, layers, scores), or compare several."""

    out: Path | None = None
    """Folder to write to. Default: the run's own; with several runs the first one's."""
    figures: bool = False
    """Also write every figure as SVG, PNG and CSV, to the folder figures (or comparison_figures)."""
    trust: bool = False
    """Import modules that the runs name, although you did not make them: this runs their code."""
    json: bool = False
    """Print the page's numbers as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(ReportOptions, argv, "report", ReportOptions())
    return write_page([*names] or [None], parse(ReportOptions, rest, "report", ReportOptions()))


def write_page(names: list[str | None], options: ReportOptions) -> int:
    """Write the page of runs, and say where it is; None is the newest run."""
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.viewing.progress_bar import ProgressBars
    from switchmt_snn.viewing.report.page import write_report

    found = [open_run(name).path for name in names]
    runs = [open_run(path, to_write=True).path for path in found]
    with ProgressBars():
        page = write_report(runs, options.out, options.figures)
    if options.json:
        output.print_json(page.with_suffix(".json").read_text("utf-8"))
    else:
        print(page)
    return 0
