"""What a picture is made of: lines, areas, boxes, dots and labels in units of one pixel, with colours by role."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LIGHT = {
    "ink": "#1d252b",
    "soft": "#5b6770",
    "line": "#d7dde1",
    "paper": "#ffffff",
    "s0": "#1b6e8c",
    "s1": "#b4532a",
    "s2": "#2b7a4b",
    "s3": "#7a4b8c",
    "s4": "#8a6a00",
    "s5": "#b3376b",
    "s6": "#4b5bb3",
    "s7": "#5f6b30",
}
"""Colours by role. Those of series (s0 to s7) have a contrast of at least 4.5 to 1 on the paper."""
DARK = {
    "ink": "#e6ebee",
    "soft": "#a3b0b8",
    "line": "#37424a",
    "paper": "#14191d",
    "s0": "#5db8d8",
    "s1": "#ef9a6e",
    "s2": "#6cc78f",
    "s3": "#c79add",
    "s4": "#dcb94a",
    "s5": "#f08ab4",
    "s6": "#9aa8f2",
    "s7": "#b7c672",
}
"""The same roles on dark paper."""
SERIES_COLOURS = 8

Point = tuple[float, float]


@dataclass(frozen=True)
class Line:
    """A line through points; ``series`` is the number of what it shows, None for an axis."""

    points: tuple[Point, ...]
    colour: str
    width: float = 1.5
    dashed: bool = False
    series: int | None = None


@dataclass(frozen=True)
class Area:
    """A filled polygon."""

    points: tuple[Point, ...]
    colour: str
    opacity: float
    series: int | None = None


@dataclass(frozen=True)
class Box:
    """A filled rectangle; ``title`` is shown where the pointer rests. An opacity of 0 only carries its title."""

    x: float
    y: float
    width: float
    height: float
    colour: str
    opacity: float = 1.0
    title: str = ""
    series: int | None = None


@dataclass(frozen=True)
class Dot:
    """A filled circle."""

    x: float
    y: float
    radius: float
    colour: str
    opacity: float = 1.0
    series: int | None = None


@dataclass(frozen=True)
class Label:
    """A line of text; ``y`` is its baseline. With a halo it stays readable over lines."""

    x: float
    y: float
    text: str
    size: float = 12.0
    anchor: Literal["start", "middle", "end"] = "start"
    colour: str = "soft"
    halo: bool = False
    series: int | None = None


Mark = Line | Area | Box | Dot | Label


@dataclass(frozen=True)
class Picture:
    """Marks in the order in which they are drawn."""

    width: float
    height: float
    title: str
    marks: tuple[Mark, ...]


def series_colour(index: int) -> str:
    """The role of a series' colour; they repeat after eight."""
    return f"s{index % SERIES_COLOURS}"


def text_width(text: str, size: float) -> float:
    """About how wide a text is in the page's font."""
    return 0.56 * size * len(text)
