"""A picture as SVG."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from itertools import groupby

from switchmt_snn.drawing.marks import LIGHT, Area, Box, Dot, Label, Line, Mark, Picture, Point

_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


def inline_svg(picture: Picture, of_class: str = "") -> str:
    """For a page: colours are its CSS variables (``--ink``, ``--s0``), series are groups that it can hide."""
    return _svg(picture, lambda role: f"var(--{role})", f' class="{of_class}"' if of_class else "")


def standalone_svg(picture: Picture) -> str:
    """A file of its own, on white paper."""
    paper = Box(0, 0, picture.width, picture.height, "paper")
    with_paper = Picture(picture.width, picture.height, picture.title, (paper, *picture.marks))
    size = f' width="{_n(picture.width)}" height="{_n(picture.height)}" font-family="{_FONT}"'
    return _svg(with_paper, lambda role: LIGHT[role], size) + "\n"


def _svg(picture: Picture, colour: Callable[[str], str], attributes: str) -> str:
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_n(picture.width)} {_n(picture.height)}" '
        f'role="img" aria-label="{escape(picture.title)}"{attributes}>'
    ]
    for series, marks in groupby(picture.marks, lambda mark: mark.series):
        drawn = "".join(_mark(mark, colour) for mark in marks)
        parts.append(drawn if series is None else f'<g data-series="{series}">{drawn}</g>')
    return "\n".join([*parts, "</svg>"])


def _mark(mark: Mark, colour: Callable[[str], str]) -> str:
    paint = colour(mark.colour)
    if isinstance(mark, Line):
        dash = ' stroke-dasharray="5 4"' if mark.dashed else ""
        return (
            f'<polyline points="{_points(mark.points)}" fill="none" stroke="{paint}" stroke-width="{_n(mark.width)}" '
            f'stroke-linejoin="round"{dash}/>'
        )
    if isinstance(mark, Area):
        return f'<polygon points="{_points(mark.points)}" fill="{paint}" fill-opacity="{_n(mark.opacity)}"/>'
    if isinstance(mark, Dot):
        opacity = f' fill-opacity="{_n(mark.opacity)}"' if mark.opacity < 1 else ""
        return f'<circle cx="{_n(mark.x)}" cy="{_n(mark.y)}" r="{_n(mark.radius)}" fill="{paint}"{opacity}/>'
    if isinstance(mark, Label):
        halo = f' stroke="{colour("paper")}" stroke-width="3" paint-order="stroke"' if mark.halo else ""
        return (
            f'<text x="{_n(mark.x)}" y="{_n(mark.y)}" font-size="{_n(mark.size)}" text-anchor="{mark.anchor}" '
            f'fill="{paint}"{halo}>{escape(mark.text)}</text>'
        )
    place = f'x="{_n(mark.x)}" y="{_n(mark.y)}" width="{_n(mark.width)}" height="{_n(mark.height)}"'
    opacity = f' fill-opacity="{_n(mark.opacity)}"' if mark.opacity < 1 else ""
    inner = f"<title>{escape(mark.title)}</title>" if mark.title else ""
    return f'<rect {place} fill="{paint}"{opacity}>{inner}</rect>'


def _points(points: tuple[Point, ...]) -> str:
    return " ".join(f"{_n(x)},{_n(y)}" for x, y in points)


def _n(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
