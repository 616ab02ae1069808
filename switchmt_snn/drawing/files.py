"""Figures as files: SVG and PNG, and their data as CSV."""

from __future__ import annotations

from collections.abc import Sequence

from switchmt_snn.drawing.chart import WIDTH, Chart, Timeline, chart_csv, picture_of
from switchmt_snn.drawing.png import png_bytes
from switchmt_snn.drawing.rows import LogRows, rows_csv, rows_picture
from switchmt_snn.drawing.svg import standalone_svg


def figure_files(figures: Sequence[Chart | Timeline | LogRows]) -> dict[str, bytes]:
    """The content of each file by its name: ``NAME.svg``, ``NAME.png`` (by Pillow) and ``NAME.csv``."""
    files: dict[str, bytes] = {}
    for figure in figures:
        if isinstance(figure, LogRows):
            picture, data = rows_picture(figure, WIDTH * 2, alone=True), rows_csv(figure)
        else:
            width = WIDTH * 2 if isinstance(figure, Timeline) else WIDTH
            picture, data = picture_of(figure, width, alone=True), chart_csv(figure)
        files[f"{figure.name}.svg"] = standalone_svg(picture).encode()
        files[f"{figure.name}.png"] = png_bytes(picture)
        files[f"{figure.name}.csv"] = data.encode()
    return files
