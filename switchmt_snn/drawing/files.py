"""Figures as files: SVG and PNG, and their data as CSV."""

from __future__ import annotations

from collections.abc import Sequence

from switchmt_snn.drawing.chart import WIDTH, Chart, Timeline, chart_csv, picture_of
from switchmt_snn.drawing.png import png_bytes
from switchmt_snn.drawing.svg import standalone_svg


def figure_files(figures: Sequence[Chart | Timeline]) -> dict[str, bytes]:
    """The content of each file by its name: ``NAME.svg``, ``NAME.png`` (by Pillow) and ``NAME.csv``."""
    files: dict[str, bytes] = {}
    for figure in figures:
        width = WIDTH * 2 if isinstance(figure, Timeline) else WIDTH
        picture = picture_of(figure, width, alone=True)
        files[f"{figure.name}.svg"] = standalone_svg(picture).encode()
        files[f"{figure.name}.png"] = png_bytes(picture)
        files[f"{figure.name}.csv"] = chart_csv(figure).encode()
    return files
