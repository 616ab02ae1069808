"""Charts: what is drawn is where its number says, in both formats, and nothing leaves the picture."""

from __future__ import annotations

import csv
import io
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from switchmt_snn.drawing.chart import Chart, Reference, Series, Span, Timeline, chart_csv, picture_of, ticks
from switchmt_snn.drawing.files import figure_files
from switchmt_snn.drawing.marks import DARK, LIGHT, Area, Box, Dot, Line
from switchmt_snn.drawing.svg import inline_svg, standalone_svg

NUMBERS = st.floats(-1e12, 1e12, allow_nan=False)


def chart(*series: Series, **more: object) -> Chart:
    return Chart("c", "A <title> & more", "steps", series, **more)  # type: ignore[arg-type]


@pytest.mark.slow
@given(NUMBERS, st.floats(1e-9, 1e9), st.integers(1, 12))
def test_ticks_lie_in_the_range_and_are_evenly_spaced(low: float, width: float, wanted: int) -> None:
    high = low + width
    if high - low < 1e-6 * max(1.0, abs(low)):
        return
    found = ticks(low, high, wanted)
    slack = (high - low) * 1e-6
    assert all(low - slack <= value <= high + slack for value in found)
    assert len(found) <= 2 * wanted + 2
    if len(found) > 2:
        np.testing.assert_allclose(np.diff(found), found[1] - found[0], rtol=1e-3)


@pytest.mark.slow
@given(st.lists(st.tuples(NUMBERS, st.one_of(st.none(), NUMBERS, st.just(float("nan")))), min_size=0, max_size=30))
def test_nothing_is_drawn_outside_of_the_picture(points: list[tuple[float, float | None]]) -> None:
    points = sorted(points, key=lambda point: point[0])
    x, y = tuple(abs(one) for one, _ in points), tuple(two for _, two in points)
    order = sorted(range(len(x)), key=lambda i: x[i])
    series = Series("a", tuple(x[i] for i in order), tuple(y[i] for i in order))
    for alone in (False, True):
        picture = picture_of(chart(series, references=(Reference("r", 1.0),)), alone=alone)
        for mark in picture.marks:
            if isinstance(mark, Line | Area):
                places = mark.points
            elif isinstance(mark, Dot):
                places = ((mark.x, mark.y),)
            elif isinstance(mark, Box):
                places = ((mark.x, mark.y), (mark.x + mark.width, mark.y + mark.height))
            else:
                places = ()
            assert all(-1 <= a <= picture.width + 1 and -1 <= b <= picture.height + 1 for a, b in places)


def test_gaps_part_a_line_and_values_are_where_the_axis_says() -> None:
    series = Series("a", (0, 1, 2, 3, 4), (0.0, 1.0, None, 1.0, 0.0))
    lines = [mark for mark in picture_of(chart(series)).marks if isinstance(mark, Line) and mark.series == 0]
    assert [len(line.points) for line in lines] == [2, 2]
    (x0, y0), (x1, y1) = lines[0].points
    assert x1 - x0 == pytest.approx(lines[1].points[1][0] - lines[1].points[0][0])
    assert y0 > y1, "larger values are higher"
    assert lines[1].points[1][1] == pytest.approx(y0)


def test_a_reference_far_away_does_not_flatten_the_data() -> None:
    near, far = Reference("near", 12.0), Reference("far", 500.0)
    text = inline_svg(picture_of(chart(Series("a", (0, 1), (0.0, 10.0)), references=(near, far))))
    assert "near 12" in text
    assert "far" not in text


def test_svg_is_xml_that_escapes_names_and_needs_no_network() -> None:
    figures = [
        chart(Series("<b>", (0, 1), (0.0, 1.0), low=(0, 0.5), high=(1, 2)), Series("dots", (0, 1), (1.0, 2.0), "dots")),
        Timeline("t", "Tasks", "steps", ("a&b", "c"), (Span(0, 0, 5, 1.0, "a & b"), Span(1, 5, 9, 0.5)), 9.0),
    ]
    for figure in figures:
        for text in (inline_svg(picture_of(figure)), standalone_svg(picture_of(figure, alone=True))):
            root = ElementTree.fromstring(text)
            assert root.get("role") == "img"
            assert root.get("aria-label") == figure.title
            assert set(re.findall(r"https?://[^\"' ]+", text)) == {"http://www.w3.org/2000/svg"}
    assert "var(--" not in standalone_svg(picture_of(figures[0], alone=True))


@pytest.mark.slow
def test_png_shows_the_same_as_svg() -> None:
    """The colour of the line is there, at its height: a low value is drawn low."""
    for value, half in ((0.0, "lower"), (1.0, "upper")):
        levels = Series("level", (0, 10), (value, value)), Series("range", (0, 10), (0.0, 1.0), "dashed", colour=1)
        content = figure_files([chart(*levels)])["c.png"]
        pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
        wanted = np.array([int(LIGHT["s0"][i : i + 2], 16) for i in (1, 3, 5)])
        rows = np.flatnonzero((np.abs(pixels - wanted).sum(axis=2) < 12).sum(axis=1) > pixels.shape[1] / 2)
        assert len(rows), "a line across"
        assert (rows.mean() > pixels.shape[0] / 2) == (half == "lower")


def test_the_data_of_a_figure_read_back() -> None:
    series = Series("a, b", (0, 1), (0.1, None), low=(0.0, None), high=(1 / 3, None))
    rows = list(csv.DictReader(io.StringIO(chart_csv(chart(series, references=(Reference("r", -2.5),))))))
    assert [float(row["high"]) for row in rows if row["high"]] == [1 / 3]
    assert [row["series"] for row in rows] == ["a, b", "a, b", "r"]
    assert rows[1]["y"] == ""


def luminance(colour: str) -> float:
    parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("palette", [LIGHT, DARK])
def test_text_and_series_are_readable_on_their_paper(palette: dict[str, str]) -> None:
    """WCAG 2: a contrast of 4.5 to 1."""
    paper = luminance(palette["paper"])
    for role in palette.keys() - {"paper", "line"}:
        low, high = sorted((luminance(palette[role]), paper))
        assert (high + 0.05) / (low + 0.05) >= 4.5, role
