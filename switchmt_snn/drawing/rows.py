"""Values in rows on a logarithmic axis, for things that differ by orders of magnitude, as costs on chips do."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from typing import Literal

from switchmt_snn.drawing.marks import Box, Dot, Label, Line, Mark, Picture, series_colour, text_width
from switchmt_snn.drawing.numbers import digits

_SIZE = 12.0
_ROW, _TALL_ROW = 34.0, 52.0
"""A row beside its name, and one under its name, where the picture is narrow."""
_NARROW = 600.0
_SPREAD, _MOST_SPREAD = 3.0, 24.0
"""Dots of a row are so many pixels above each other, and all within so many: equal values do not hide one another."""
_RIGHT, _TOP, _BOTTOM = 16.0, 8.0, 40.0


@dataclass(frozen=True)
class RowValue:
    """A value of a series in a row, and the range that it is the mean of."""

    row: int
    series: int
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class RowSeries:
    """What is drawn alike in all rows. ``part`` is a coloured dot, ``whole`` a large dark one, ``other`` a dash."""

    name: str
    style: Literal["part", "whole", "other"] = "part"


@dataclass(frozen=True)
class LogRows:
    """One figure: a row per thing, a logarithmic axis below. Values of 0 and less have no place on it.

    Attributes:
        name: of its files.
        title: of a picture that stands alone.
        x_label: what is measured, with its unit.
        note: what the reader must know of how it was made.
    """

    name: str
    title: str
    x_label: str
    rows: tuple[str, ...]
    series: tuple[RowSeries, ...]
    values: tuple[RowValue, ...]
    note: str = ""


def rows_csv(figure: LogRows) -> str:
    """The data of a figure, a row per value."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["row", "series", "value", "low", "high"])
    for one in figure.values:
        writer.writerow([figure.rows[one.row], figure.series[one.series].name, one.value, one.low, one.high])
    return text.getvalue()


def rows_picture(figure: LogRows, width: float, alone: bool = False) -> Picture:
    """Lay a figure out.

    Args:
        figure: what to show.
        width: in pixels; names stand above their rows where it is narrow.
        alone: for a file of its own, with its title and without texts for the pointer.
    """
    narrow = width < _NARROW
    left = 10.0 if narrow else 18.0 + max((text_width(name, _SIZE) for name in figure.rows), default=0.0)
    marks, top = _legend(figure, width, alone)
    axis = _Axis.of(figure, left, width - left - _RIGHT)
    row_height = _TALL_ROW if narrow else _ROW
    bottom = top + row_height * len(figure.rows)
    for power in axis.powers():
        x = axis.x(10.0**power)
        marks.append(Line(((x, top), (x, bottom + 4)), "line", 1.0))
        text = f"{10**power:,}" if power >= 0 else f"{10.0**power:g}"
        half = text_width(text, _SIZE) / 2
        marks.append(Label(min(max(x, half), width - half), bottom + 17, text, _SIZE, "middle"))
    for row, name in enumerate(figure.rows):
        y = top + row * row_height
        middle = y + row_height - _ROW / 2
        if narrow:
            marks.append(Label(left, y + 15, name, _SIZE, "start", "ink"))
        else:
            marks.append(Label(left - 10, middle + 4, name, _SIZE, "end", "ink"))
        marks.append(Line(((left, y + row_height), (left + axis.width, y + row_height)), "line", 1.0))
        here = [one for one in figure.values if one.row == row]
        marks += [mark for one in here if one.value > 0 for mark in _value(figure, axis, one, middle)]
        if here and not alone:
            lines = [f"{figure.series[one.series].name}: {_spoken(one)}" for one in here]
            marks.append(Box(left, y, axis.width, row_height, "paper", 0.0, "\n".join([name, *lines])))
    marks.append(Label(left + axis.width / 2, bottom + 34, figure.x_label, _SIZE, "middle"))
    return Picture(width, bottom + _BOTTOM, figure.title, tuple(marks))


@dataclass(frozen=True)
class _Axis:
    """From one power of ten to another."""

    left: float
    width: float
    lowest: int
    highest: int

    @classmethod
    def of(cls, figure: LogRows, left: float, width: float) -> _Axis:
        ends = [end for one in figure.values for end in (one.low, one.value, one.high) if end > 0]
        lowest = math.floor(math.log10(min(ends, default=1.0)))
        return cls(left, width, lowest, max(lowest + 1, math.ceil(math.log10(max(ends, default=1.0)))))

    def x(self, value: float) -> float:
        return self.left + (math.log10(value) - self.lowest) / (self.highest - self.lowest) * self.width

    def powers(self) -> range:
        fitting = max(1, int(self.width / 62))
        return range(self.lowest, self.highest + 1, -(-(self.highest - self.lowest) // fitting))


def _value(figure: LogRows, axis: _Axis, one: RowValue, middle: float) -> list[Mark]:
    style, x = figure.series[one.series].style, axis.x(one.value)
    if style == "other":
        return [Line(((x, middle - 11), (x, middle + 11)), "ink", 2.0)]
    if style == "whole":
        return [*_range(axis, one, middle, "ink"), Dot(x, middle, 5.0, "ink")]
    parts = [index for index, series in enumerate(figure.series) if series.style == "part"]
    apart = min(_SPREAD, _MOST_SPREAD / len(parts))
    y, colour = middle + apart * (parts.index(one.series) - (len(parts) - 1) / 2), series_colour(one.series)
    return [*_range(axis, one, y, colour), Dot(x, y, 3.5, colour)]


def _range(axis: _Axis, one: RowValue, y: float, colour: str) -> list[Mark]:
    if not 0 < one.low < one.high:
        return []
    return [Line(((axis.x(one.low), y), (axis.x(one.high), y)), colour, 1.5)]


def _spoken(one: RowValue) -> str:
    text = digits(one.value)
    return text if one.low == one.high else f"{text} ({digits(one.low)} to {digits(one.high)})"


def _legend(figure: LogRows, width: float, alone: bool) -> tuple[list[Mark], float]:
    """Title, names of the series, and where the rows begin."""
    marks: list[Mark] = [Label(10, 20, figure.title, 14.0, "start", "ink")] if alone else []
    x, y = 10.0, 38.0 if alone else 14.0
    for index, series in enumerate(figure.series):
        needed = 16 + text_width(series.name, 11.0) + 12
        if x > 10 and x + needed > width:
            x, y = 10.0, y + 16
        if series.style == "part":
            marks.append(Dot(x + 5, y - 4, 3.5, series_colour(index)))
        elif series.style == "whole":
            marks.append(Dot(x + 5, y - 4, 5.0, "ink"))
        elif series.style == "other":
            marks.append(Line(((x + 5, y - 10), (x + 5, y + 2)), "ink", 2.0))
        marks.append(Label(x + 14, y, series.name, 11.0))
        x += needed
    return marks, y + _TOP
