"""A picture as PNG, drawn by Pillow: larger than it will be, then reduced, so that lines are smooth."""

from __future__ import annotations

import io
import math
from itertools import pairwise

from PIL import Image, ImageDraw, ImageFont

from switchmt_snn.drawing.marks import LIGHT, Area, Box, Dot, Label, Line, Mark, Picture, Point

SCALE = 2
"""Pixels of the file per unit of the picture, for print and dense screens."""
_OVERSAMPLED = 2
_DASH, _GAP = 5.0, 4.0
_SPELLED = str.maketrans({"µ": "u"})
"""What Pillow's font does not have."""
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


def png_bytes(picture: Picture) -> bytes:
    """The content of a PNG file, on white paper."""
    scale = SCALE * _OVERSAMPLED
    image = Image.new("RGB", (round(picture.width * scale), round(picture.height * scale)), LIGHT["paper"])
    canvas = ImageDraw.Draw(image, "RGBA")  # RGBA: blends what is not opaque
    for mark in picture.marks:
        _draw(canvas, mark, scale)
    small = image.reduce(_OVERSAMPLED)
    stream = io.BytesIO()
    small.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _draw(canvas: ImageDraw.ImageDraw, mark: Mark, scale: float) -> None:
    def at(points: tuple[Point, ...]) -> list[Point]:
        return [(x * scale, y * scale) for x, y in points]

    if isinstance(mark, Line):
        width = max(1, round(mark.width * scale))
        for piece in _dashes(mark.points) if mark.dashed else [mark.points]:
            canvas.line(at(piece), fill=_paint(mark.colour), width=width, joint="curve")
    elif isinstance(mark, Area):
        if len(mark.points) > 2:
            canvas.polygon(at(mark.points), fill=_paint(mark.colour, mark.opacity))
    elif isinstance(mark, Dot):
        low, high = at(((mark.x - mark.radius, mark.y - mark.radius), (mark.x + mark.radius, mark.y + mark.radius)))
        canvas.ellipse([low, high], fill=_paint(mark.colour, mark.opacity))
    elif isinstance(mark, Label):
        font = ImageFont.load_default(mark.size * scale)
        place, halo = at(((mark.x, mark.y),))[0], round(1.5 * scale) if mark.halo else 0
        anchor, paper = _ANCHORS[mark.anchor], _paint("paper")
        text, ink = mark.text.translate(_SPELLED), _paint(mark.colour)
        canvas.text(place, text, ink, font, anchor, stroke_width=halo, stroke_fill=paper)
    else:
        _box(canvas, mark, scale)


def _box(canvas: ImageDraw.ImageDraw, mark: Box, scale: float) -> None:
    if mark.opacity > 0 and mark.width > 0 and mark.height > 0:
        left, top = mark.x * scale, mark.y * scale
        right = max(left, (mark.x + mark.width) * scale - 1)
        bottom = max(top, (mark.y + mark.height) * scale - 1)
        canvas.rectangle([left, top, right, bottom], fill=_paint(mark.colour, mark.opacity))


def _paint(role: str, opacity: float = 1.0) -> tuple[int, int, int, int]:
    colour = LIGHT[role]
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return red, green, blue, round(255 * opacity)


def _dashes(points: tuple[Point, ...]) -> list[tuple[Point, Point]]:
    """The drawn pieces of a dashed line."""
    pieces = []
    along, period = 0.0, _DASH + _GAP
    for (x0, y0), (x1, y1) in pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        if length == 0:
            continue
        begin = math.floor(along / period) * period - along  # of the dash that is running
        while begin < length:
            first, last = max(begin, 0.0), min(begin + _DASH, length)
            if last > first:
                pieces.append(tuple((x0 + (x1 - x0) * d / length, y0 + (y1 - y0) * d / length) for d in (first, last)))
            begin += period
        along += length
    return [(piece[0], piece[1]) for piece in pieces]
