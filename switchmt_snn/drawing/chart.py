"""Charts: what is shown, as plain values that a JSON file can hold, and how it is laid out as a picture."""

from __future__ import annotations

import bisect
import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from switchmt_snn.drawing.marks import Area, Box, Dot, Label, Line, Mark, Picture, series_colour, text_width
from switchmt_snn.drawing.numbers import compact, digits, is_number, whole

WIDTH, HEIGHT = 420.0, 240.0
"""A panel: three beside each other on a wide screen, one on a phone, with readable text in both."""
WIDE = 1152.0
"""A chart over the whole width of the page."""
STRIPS = 60
"""Places along the x axis where the pointer finds values."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 10.0, 10.0, 40.0
_SIZE = 12.0
_DOTS = {"dots": (1.6, 0.4), "points": (2.2, 0.75), "marks": (4.0, 1.0)}
"""Radius and opacity by style."""
_SAME = 1e-10
"""Values that differ by less, or by less than this share of them, are one."""
_REACH = 0.6
"""A reference that is further from the data than this share of their range would flatten them; it is named instead."""


@dataclass(frozen=True)
class Series:
    """Values over x.

    Attributes:
        y: None leaves a gap.
        low, high: a band around y; empty without.
        style: ``dots`` are faint, for many; ``points`` plain; ``marks`` large. ``band`` draws only the band.
        colour: number of its colour; None takes the series' place in the chart.
    """

    name: str
    x: tuple[float, ...]
    y: tuple[float | None, ...]
    style: Literal["line", "dashed", "dots", "points", "marks", "band"] = "line"
    low: tuple[float | None, ...] = ()
    high: tuple[float | None, ...] = ()
    colour: int | None = None


@dataclass(frozen=True)
class Reference:
    """A level to compare with."""

    name: str
    y: float


@dataclass(frozen=True)
class Chart:
    """One figure.

    Attributes:
        name: of its files.
        title: with the unit of y, if it has one.
        note: what the reader must know of how it was made.
        y_range: what the axis covers at least; None where the data decide.
    """

    name: str
    title: str
    x_label: str
    series: tuple[Series, ...]
    references: tuple[Reference, ...] = ()
    note: str = ""
    y_range: tuple[float | None, float | None] = (None, None)
    y_percent: bool = False


@dataclass(frozen=True)
class Span:
    """A stretch of a row; ``share`` is how much of it the row has, drawn as opacity."""

    row: int
    begin: float
    end: float
    share: float = 1.0
    title: str = ""


@dataclass(frozen=True)
class Timeline:
    """Which row was active when."""

    name: str
    title: str
    x_label: str
    rows: tuple[str, ...]
    spans: tuple[Span, ...]
    end: float
    note: str = ""
    series: tuple[Series, ...] = field(default=(), init=False)


def chart_csv(figure: Chart | Timeline) -> str:
    """The data of a figure, a row per point."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if isinstance(figure, Timeline):
        writer.writerow(["row", "begin", "end", "share"])
        writer.writerows([figure.rows[span.row], span.begin, span.end, span.share] for span in figure.spans)
        return text.getvalue()
    writer.writerow(["series", "x", "y", "low", "high"])
    for series in figure.series:
        low, high = (band or ("",) * len(series.x) for band in (series.low, series.high))
        rows = zip(series.x, series.y, low, high, strict=True)
        writer.writerows([series.name, *("" if value is None else value for value in row)] for row in rows)
    writer.writerows([reference.name, "", reference.y, "", ""] for reference in figure.references)
    return text.getvalue()


def picture_of(figure: Chart | Timeline, width: float = WIDTH, alone: bool = False) -> Picture:
    """Lay a figure out.

    Args:
        figure: what to show.
        width: in pixels.
        alone: for a file of its own: with title and legend, which a page writes itself, and without hover strips.
    """
    if isinstance(figure, Timeline):
        return _timeline(figure, width, alone)
    return _chart(figure, width, alone)


def visible_references(chart: Chart) -> tuple[tuple[Reference, ...], tuple[Reference, ...]]:
    """References near the data, which are drawn, and the others."""
    low, high = _data_range(chart)
    reach = _REACH * (high - low)
    near = tuple(one for one in chart.references if low - reach <= one.y <= high + reach)
    return near, tuple(one for one in chart.references if one not in near)


def _data_range(chart: Chart) -> tuple[float, float]:
    values = [
        value
        for series in chart.series
        for values in (series.y if series.style != "band" else (), series.low, series.high)
        for value in values
        if value is not None and is_number(value)
    ]
    values += [value for value in chart.y_range if value is not None]
    low, high = min(values, default=0.0), max(values, default=1.0)
    size = max(abs(low), abs(high))
    if high - low <= _SAME * max(size, 1.0 if size < _SAME else size):  # one value: room above and below it
        margin = 0.5 * (size if size >= _SAME else 1.0)
        low, high = low - margin, high + margin
    return low, high


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers within a range.

    Examples:
        >>> ticks(0.0, 10.0), ticks(-21.0, -18.0, 3)
        ([0.0, 2.0, 4.0, 6.0, 8.0, 10.0], [-21.0, -20.0, -19.0, -18.0])
    """
    rough = (high - low) / max(1, wanted)
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * unit for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * unit >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    count = math.floor(high / step + 1e-9) - first + 1
    return [round((first + index) * step, 12) + 0.0 for index in range(count)]


@dataclass(frozen=True)
class _Frame:
    """The plot's place and scales."""

    left: float
    top: float
    width: float
    height: float
    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def x(self, value: float) -> float:
        return self.left + (value - self.x_low) / (self.x_high - self.x_low) * self.width

    def y(self, value: float) -> float:
        return self.top + (self.y_high - value) / (self.y_high - self.y_low) * self.height

    @property
    def bottom(self) -> float:
        return self.top + self.height


def _chart(chart: Chart, width: float, alone: bool) -> Picture:
    heading, taken = _heading(chart, width) if alone else ([], 0.0)
    near, _ = visible_references(chart)
    low, high = _data_range(chart)
    low, high = min([low, *(one.y for one in near)]), max([high, *(one.y for one in near)])
    margin = 0.04 * (high - low)
    floor, ceiling = chart.y_range
    frame = _Frame(
        _LEFT,
        _TOP + taken,
        width - _LEFT - _RIGHT,
        HEIGHT - _TOP - _BOTTOM,
        *_x_range([x for series in chart.series for x in series.x]),
        low if floor is not None and low >= floor else low - margin,
        high if ceiling is not None and high <= ceiling else high + margin,
    )
    marks: list[Mark] = [*heading, *_axes(frame, chart.x_label, chart.y_percent)]
    for index, series in enumerate(chart.series):
        marks += _series(frame, series, index)
    marks += _references(frame, near)
    if not alone:
        marks += _strips(frame, chart)
    return Picture(width, HEIGHT + taken, chart.title, tuple(marks))


def _x_range(values: list[float]) -> tuple[float, float]:
    low, high = min([0.0, *values]), max(values, default=1.0)
    return (low, high) if high - low > _SAME else (low, low + 1.0)


def _axes(frame: _Frame, x_label: str, y_percent: bool) -> list[Mark]:
    marks: list[Mark] = []
    right = frame.left + frame.width
    for value in ticks(frame.y_low, frame.y_high, 4):
        y = frame.y(value)
        text = f"{value * 100:.4g} %" if y_percent else compact(value)
        marks += [
            Line(((frame.left, y), (right, y)), "line", 1.0),
            Label(frame.left - 6, y + 4, text, _SIZE, "end"),
        ]
    for value in ticks(frame.x_low, frame.x_high, max(3, int(frame.width / 80))):
        x = frame.x(value)
        marks += [
            Line(((x, frame.bottom), (x, frame.bottom + 4)), "soft", 1.0),
            Label(min(x, right - 10), frame.bottom + 16, compact(value), _SIZE, "middle"),
        ]
    marks.append(Line(((frame.left, frame.bottom), (right, frame.bottom)), "soft", 1.0))
    marks.append(Label(frame.left + frame.width / 2, frame.bottom + 33, x_label, _SIZE, "middle"))
    return marks


def _series(frame: _Frame, series: Series, index: int) -> list[Mark]:
    colour = series_colour(index if series.colour is None else series.colour)
    marks: list[Mark] = []
    if series.low:
        for piece in _pieces(series.x, series.low, series.high):
            upper = [(frame.x(x), frame.y(high)) for x, _, high in piece]
            lower = [(frame.x(x), frame.y(low)) for x, low, _ in reversed(piece)]
            marks.append(Area((*upper, *lower), colour, 0.18, index))
    if series.style in _DOTS:
        radius, opacity = _DOTS[series.style]
        for x, y in zip(series.x, series.y, strict=True):
            if y is not None and is_number(y):
                marks.append(Dot(frame.x(x), frame.y(y), radius, colour, opacity, index))
    elif series.style != "band":
        for piece in _pieces(series.x, series.y, series.y):
            points = tuple((frame.x(x), frame.y(y)) for x, y, _ in piece)
            if len(points) == 1:
                marks.append(Dot(*points[0], 2.0, colour, 1.0, index))
            else:
                marks.append(Line(points, colour, 1.8, series.style == "dashed", index))
    return marks


def _pieces(
    x: Sequence[float], low: Sequence[float | None], high: Sequence[float | None]
) -> list[list[tuple[float, float, float]]]:
    """Stretches without a gap."""
    pieces: list[list[tuple[float, float, float]]] = [[]]
    for at, below, above in zip(x, low, high, strict=True):
        if below is None or above is None or not (is_number(below) and is_number(above)):
            pieces.append([])
        else:
            pieces[-1].append((at, below, above))
    return [piece for piece in pieces if piece]


def _references(frame: _Frame, references: Sequence[Reference]) -> list[Mark]:
    marks: list[Mark] = []
    right, taken = frame.left + frame.width, -math.inf
    for one in sorted(references, key=lambda one: frame.y(one.y)):  # from the top down
        y = frame.y(one.y)
        marks.append(Line(((frame.left, y), (right, y)), "soft", 1.2, True))
        baseline = max(y - 4, frame.top + 10, taken + 12)
        if baseline < frame.bottom - 2:
            marks.append(Label(right - 2, baseline, f"{one.name} {digits(one.y)}", 11.0, "end", "ink", True))
            taken = baseline
    return marks


def _strips(frame: _Frame, chart: Chart) -> list[Mark]:
    """Invisible boxes side by side; each one's title names the values nearest to its middle."""
    shown = [series for series in chart.series if series.style != "dots" and series.x]
    places = len({x for series in shown for x in series.x})
    count = min(STRIPS, places)
    if count == 0:
        return []
    width = frame.width / count
    marks: list[Mark] = []
    for index in range(count):
        middle = frame.x_low + (index + 0.5) * (frame.x_high - frame.x_low) / count
        lines = [line for series in shown for line in _at(series, middle, chart.y_percent)]
        if lines:
            place = whole(middle) if frame.x_high - frame.x_low > STRIPS else digits(middle)
            title = "\n".join([f"near {chart.x_label} {place}", *lines])
            marks.append(Box(frame.left + index * width, frame.top, width, frame.height, "paper", 0.0, title))
    return marks


def _at(series: Series, x: float, y_percent: bool) -> list[str]:
    place = bisect.bisect_left(series.x, x)
    place = min((p for p in (place - 1, place) if 0 <= p < len(series.x)), key=lambda p: abs(series.x[p] - x))
    y = series.y[place]

    def shown(value: float) -> str:
        return f"{value:.1%}" if y_percent else digits(value)

    if y is None or not is_number(y):
        return []
    text = f"{series.name}: {shown(y)}"
    if series.low:
        low, high = series.low[place], series.high[place]
        if low is not None and high is not None:
            text += f" ({shown(low)} to {shown(high)})"
    return [text]


def _heading(figure: Chart | Timeline, width: float) -> tuple[list[Mark], float]:
    """Title and legend of a figure that stands alone, and the height that they take."""
    marks: list[Mark] = [Label(10, 20, figure.title, 14.0, "start", "ink")]
    names = [series.name for series in figure.series]
    if len(names) < 2:
        return marks, 24.0
    x, y = 10.0, 38.0
    for index, series in enumerate(figure.series):
        needed = 16 + text_width(series.name, 11.0) + 12
        if x > 10 and x + needed > width:
            x, y = 10.0, y + 16
        colour = series_colour(index if series.colour is None else series.colour)
        marks += [Box(x, y - 9, 10, 10, colour), Label(x + 14, y, series.name, 11.0)]
        x += needed
    return marks, y + 2


_ROW = 26.0


def _timeline(figure: Timeline, width: float, alone: bool) -> Picture:
    heading, taken = _heading(figure, width) if alone else ([], 0.0)
    height = _ROW * len(figure.rows)
    names = [_shortened(name, width / 3) for name in figure.rows]
    left = 14 + max(text_width(name, _SIZE) for name in names)
    frame = _Frame(left, _TOP + taken, width - left - _RIGHT, height, *_x_range([0.0, figure.end]), 0.0, 1.0)
    marks: list[Mark] = list(heading)
    for index, name in enumerate(names):
        top = frame.top + index * _ROW
        marks.append(Label(left - 8, top + _ROW / 2 + 4, name, _SIZE, "end", "ink"))
        marks.append(Line(((left, top + _ROW), (left + frame.width, top + _ROW)), "line", 1.0))
    for span in figure.spans:
        x = frame.x(span.begin)
        place = (x, frame.top + span.row * _ROW + 3, max(0.6, frame.x(span.end) - x), _ROW - 6)
        title = "" if alone else span.title
        marks.append(Box(*place, series_colour(span.row), 0.15 + 0.85 * span.share, title))
    for value in ticks(0.0, frame.x_high, max(3, int(frame.width / 80))):
        x = frame.x(value)
        marks.append(Line(((x, frame.bottom), (x, frame.bottom + 4)), "soft", 1.0))
        marks.append(Label(min(x, left + frame.width - 10), frame.bottom + 16, compact(value), _SIZE, "middle"))
    marks.append(Label(left + frame.width / 2, frame.bottom + 33, figure.x_label, _SIZE, "middle"))
    return Picture(width, frame.bottom + _BOTTOM, figure.title, tuple(marks))


def _shortened(name: str, width: float) -> str:
    room = int(width / (0.56 * _SIZE))
    return name if len(name) <= room else name[: room - 1] + "…"
