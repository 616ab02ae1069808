"""Values in rows on a logarithmic axis: where they stand, and that nothing leaves the picture."""

from __future__ import annotations

import csv
import io

import pytest

from switchmt_snn.drawing.marks import Dot, Label, Line, text_width
from switchmt_snn.drawing.rows import LogRows, RowSeries, RowValue, rows_csv, rows_picture

FIGURE = LogRows(
    name="costs",
    title="Costs",
    x_label="µJ",
    rows=("chip one", "chip two"),
    series=(RowSeries("conv"), RowSeries("all", "whole"), RowSeries("ANN", "other")),
    values=(
        RowValue(0, 0, 0.002, 0.001, 0.004),
        RowValue(0, 1, 10.0, 10.0, 10.0),
        RowValue(0, 2, 1000.0, 1000.0, 1000.0),
        RowValue(1, 0, 0.0, 0.0, 0.0),
        RowValue(1, 1, 100_000.0, 90_000.0, 110_000.0),
    ),
)


@pytest.mark.parametrize("width", [360.0, 1152.0])
def test_equal_ratios_are_equal_distances(width: float) -> None:
    marks = rows_picture(FIGURE, width).marks
    first = [mark.x for mark in marks if isinstance(mark, Dot) and mark.radius == 5.0][-2:]
    uprights = [mark.points[0][0] for mark in marks if isinstance(mark, Line) and mark.width == 2.0]
    assert len(first) == len(uprights) == 2, "the legend's and the row's dash"
    dash = uprights[1]
    assert dash - first[0] == pytest.approx(first[1] - dash), "10 to 1,000 is as far as 1,000 to 100,000"


@pytest.mark.parametrize("width", [360.0, 1152.0])
@pytest.mark.parametrize("alone", [True, False])
def test_nothing_leaves_the_picture(width: float, alone: bool) -> None:
    picture = rows_picture(FIGURE, width, alone)
    for mark in picture.marks:
        if isinstance(mark, Label):
            wide = text_width(mark.text, mark.size)
            left = mark.x - {"start": 0.0, "middle": wide / 2, "end": wide}[mark.anchor]
            assert -0.01 <= left <= picture.width - wide + 0.01, mark
            assert 0 < mark.y < picture.height
        elif isinstance(mark, Line):
            assert all(-0.01 <= x <= picture.width for x, _ in mark.points)


def test_what_costs_nothing_has_no_place_on_the_axis_but_stands_in_the_csv() -> None:
    dots = [mark for mark in rows_picture(FIGURE, 1152.0).marks if isinstance(mark, Dot)]
    in_legend = 2
    assert len(dots) == in_legend + 3
    rows = list(csv.DictReader(io.StringIO(rows_csv(FIGURE))))
    assert len(rows) == len(FIGURE.values)
    assert rows[3] == {"row": "chip two", "series": "conv", "value": "0.0", "low": "0.0", "high": "0.0"}
