"""From facts to files: ``report.html`` with ``report.json``, ``comparison.html`` with ``comparison.json``, figures."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from markupsafe import Markup

from switchmt_snn.drawing.chart import WIDE, Chart, Timeline, picture_of, visible_references
from switchmt_snn.drawing.files import figure_files
from switchmt_snn.drawing.marks import series_colour
from switchmt_snn.drawing.numbers import compact, digits, duration
from switchmt_snn.drawing.page import page_environment
from switchmt_snn.drawing.svg import inline_svg
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.runs.files import json_text, made, write_atomically
from switchmt_snn.viewing.report.comparison import (
    Group,
    comparison_facts,
    comparison_figures,
    differing_settings,
    grouped,
)
from switchmt_snn.viewing.report.facts import figures_of, run_facts
from switchmt_snn.viewing.report.sources import Sources, read_sources


def write_report(runs: Sequence[str | Path], out: str | Path | None = None, figures: bool = False) -> Path:
    """Write the page of a run, or of several runs side by side.

    Args:
        runs: run folders, at least one.
        out: folder to write to; None is the run's own, of several the first one's.
        figures: also write every figure as SVG, PNG (by Pillow) and CSV.

    Returns:
        The path of ``report.html``, or with several runs of ``comparison.html``. A JSON file beside it holds every
        number that the page shows.

    Raises:
        SwitchMTError: a folder is no run, or a file of it cannot be read.

    Examples:
        >>> from switchmt_snn.viewing.report.page import write_report
        >>> write_report(["runs/mine"])  # doctest: +SKIP
        PosixPath('runs/mine/report.html')
    """
    paths = list(dict.fromkeys(Path(run) for run in runs))
    folder = Path(out) if out is not None else paths[0]
    read = []
    with progress_of("reading logs", len(paths), "runs") as progress:
        for path in paths:
            read.append(read_sources(path))
            progress.advance()
    charts: list[Chart | Timeline]
    if len(read) == 1:
        sections = figures_of(read[0])
        facts = run_facts(read[0], sections, folder)
        run = shlex.quote(str(read[0].folder.path))
        charts = [one for ones in sections.values() for one in ones]
        name, drawn = "report", sections
    else:
        groups, differing = grouped(read)
        compared = comparison_figures(groups)
        facts = comparison_facts(groups, differing, compared)
        run = None
        charts = list(compared)
        name, drawn = "comparison", {"learning": charts}
    page = _rendered(f"{name}.html.jinja", facts, drawn, run)
    figure_folder = "figures" if name == "report" else "comparison_figures"
    return _write(folder, name, page, facts, charts if figures else [], figure_folder)


def write_comparison(
    groups: dict[str, Sequence[Sources]],
    out: Path,
    title: str,
    headline: str,
    tables: Sequence[dict[str, Any]] = (),
    sections: dict[str, list[Chart | Timeline]] | None = None,
    name: str = "report",
) -> Path:
    """Write the page of several runs whose groups are known, with tables in place of the scores.

    Args:
        groups: runs by the group's label; none is empty.
        out: folder to write to.
        title: of the page.
        headline: the line below it.
        tables: each with ``title``, ``note``, ``columns`` and ``rows`` of texts.
        sections: more figures, by the title of their section.
        name: of the files, and of the folder of figures (SVG, PNG by Pillow, CSV) with ``_figures`` behind it.

    Returns:
        The path of the page.

    Raises:
        WriteError: the folder cannot be written.
    """
    compared = [Group(label, tuple(runs)) for label, runs in groups.items()]
    charts = comparison_figures(compared)
    facts = comparison_facts(compared, differing_settings([group.runs for group in compared]), charts)
    facts |= {"title": title, "headline": headline, "tables": list(tables)}
    drawn: dict[str, list[Chart | Timeline]] = {"learning": list(charts), **(sections or {})}
    facts["figures"] = {section: [asdict(one) for one in figures] for section, figures in drawn.items()}
    page = _rendered("comparison.html.jinja", facts, drawn)
    return _write(out, name, page, facts, [one for figures in drawn.values() for one in figures], f"{name}_figures")


def _write(
    folder: Path,
    name: str,
    page: str,
    facts: dict[str, Any],
    charts: Sequence[Chart | Timeline],
    figure_folder: str,
) -> Path:
    """The page, its JSON and its figures; returns the page's path."""
    made(folder, "--out")
    write_atomically(folder / f"{name}.json", json_text(facts, indent=1).encode(), "--out")
    write_atomically(folder / f"{name}.html", page.encode(), "--out")
    if charts:
        _write_figures(made(folder / figure_folder, "--out"), charts)
    return folder / f"{name}.html"


def _write_figures(folder: Path, charts: Sequence[Chart | Timeline]) -> None:
    with progress_of("drawing", len(charts), "figures") as progress:
        for chart in charts:
            for name, content in figure_files([chart]).items():
                write_atomically(folder / name, content, "--out")
            progress.advance()


def _rendered(
    template: str, facts: dict[str, Any], drawn: dict[str, list[Chart | Timeline]], run: str | None = None
) -> str:
    """The page; ``run`` is the folder as commands take it."""
    environment = page_environment("switchmt_snn.viewing.report")
    environment.filters |= {"duration": duration, "compact": compact}
    environment.globals |= {"picture": _picture, "colour": series_colour, "beyond": _beyond}
    folded = [one.name for one in drawn.get("layers", ()) if one.name.startswith("saturated")]
    return environment.get_template(template).render(facts=facts, drawn=drawn, folded=folded, run=run)


def _picture(figure: Chart | Timeline) -> Markup:
    """A figure as SVG; a timeline in two widths, of which the page shows the one that fits."""
    if isinstance(figure, Timeline):
        return Markup(inline_svg(picture_of(figure, WIDE), "wide") + inline_svg(picture_of(figure), "narrow"))
    return Markup(inline_svg(picture_of(figure)))


def _beyond(figure: Chart | Timeline) -> str:
    """References that are too far away to draw, in words."""
    if isinstance(figure, Timeline):
        return ""
    _, far = visible_references(figure)
    return "Beyond the axis: " + ", ".join(f"{one.name} {digits(one.y)}" for one in far) + "." if far else ""
