"""What panels are drawn with: colours, texts, rectangles.

The colours are those of Okabe and Ito (2008), which people with colour blindness tell apart, on a dark ground. What a
colour says is also said by a form or a text.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

GROUND: Colour = (14, 19, 26)
PANEL: Colour = (24, 32, 42)
LINE: Colour = (58, 72, 88)
TEXT: Colour = (236, 240, 244)
MUTED: Colour = (164, 178, 192)
SPIKE: Colour = (240, 228, 66)
CHOSEN: Colour = (230, 159, 0)
VALUE: Colour = (86, 180, 233)
GAIN: Colour = (0, 158, 115)
LOSS: Colour = (204, 121, 167)

SMALL, NORMAL, TITLE, LARGE = 13, 15, 22, 34
"""Heights of texts in pixels."""


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels; right and bottom are outside."""

    left: int
    top: int
    width: int
    height: int

    @property
    def right(self) -> int:
        """The first column to the right of it."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """The first row below it."""
        return self.top + self.height

    def inner(self, margin: int) -> Box:
        """Without a margin."""
        return Box(self.left + margin, self.top + margin, self.width - 2 * margin, self.height - 2 * margin)

    def cut_top(self, height: int, gap: int = 0) -> tuple[Box, Box]:
        """The uppermost part, and the rest below a gap."""
        rest = self.height - height - gap
        return Box(self.left, self.top, self.width, height), Box(self.left, self.bottom - rest, self.width, rest)

    def cut_left(self, width: int, gap: int = 0) -> tuple[Box, Box]:
        """The leftmost part, and the rest to the right of a gap."""
        rest = self.width - width - gap
        return Box(self.left, self.top, width, self.height), Box(self.right - rest, self.top, rest, self.height)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Pillow's own font, the same on every machine. It has the characters of ASCII and a few more."""
    loaded = ImageFont.load_default(size)
    assert isinstance(loaded, ImageFont.FreeTypeFont), "Pillow was built without FreeType"
    return loaded


class Canvas:
    """A picture that is drawn on."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (width, height), GROUND)
        self._draw = ImageDraw.Draw(self.image)

    def text(
        self,
        place: tuple[float, float],
        text: str,
        size: int = SMALL,
        colour: Colour = TEXT,
        anchor: str = "la",
        width: int | None = None,
    ) -> None:
        """Write a line.

        Args:
            place: x and y of the anchor.
            text: characters that the font lacks become ``?``.
            size: height.
            colour: of the text.
            anchor: as in Pillow: l, m, r for x; a (ascender), m, s (baseline) for y.
            width: longer lines are cut, with an ellipsis.
        """
        line = shortened(text, size, width)
        self._draw.text(place, line, fill=colour, font=font(size), anchor=anchor)

    def fill(self, box: Box, colour: Colour, radius: int = 0) -> None:
        """Fill a rectangle."""
        corners = (box.left, box.top, box.right - 1, box.bottom - 1)
        self._draw.rounded_rectangle(corners, radius, fill=colour)

    def line(self, points: list[tuple[float, float]], colour: Colour, width: int = 1) -> None:
        """Draw through points."""
        self._draw.line(points, fill=colour, width=width)

    def dot(self, x: float, y: float, radius: float, colour: Colour, filled: bool = True) -> None:
        """A dot, or a ring."""
        corners = (x - radius, y - radius, x + radius, y + radius)
        self._draw.ellipse(corners, fill=colour if filled else None, outline=colour, width=2)

    def triangle(self, x: float, y: float, size: float, colour: Colour, up: bool) -> None:
        """A triangle that points up or down."""
        way = -1 if up else 1
        self._draw.polygon([(x - size, y - way * size), (x + size, y - way * size), (x, y + way * size)], fill=colour)

    def diamond(self, x: float, y: float, size: float, colour: Colour) -> None:
        """A square on its corner."""
        self._draw.polygon([(x, y - size), (x + size, y), (x, y + size), (x - size, y)], fill=colour)

    def paste(self, pixels: npt.NDArray[np.uint8], box: Box, smooth: bool = False) -> Box:
        """A picture as large as fits, in the middle of a box; returns where it is."""
        height, width = pixels.shape[:2]
        scale = min(box.width / width, box.height / height)
        if scale >= 2 and not smooth:
            scale = int(scale)  # pixels stay squares of one size
        wide, high = max(1, round(width * scale)), max(1, round(height * scale))
        how = Image.Resampling.LANCZOS if smooth or scale < 1 else Image.Resampling.NEAREST
        picture = Image.fromarray(pixels).resize((wide, high), how)
        place = Box(box.left + (box.width - wide) // 2, box.top + (box.height - high) // 2, wide, high)
        self.image.paste(picture, (place.left, place.top))
        return place

    def paste_exactly(self, pixels: npt.NDArray[np.uint8], left: int, top: int) -> None:
        """Pixels as they are."""
        self.image.paste(Image.fromarray(pixels), (left, top))


@functools.lru_cache(4096)
def shortened(text: str, size: int, width: int | None) -> str:
    """A text of printable characters that the font has, cut to a width."""
    text = "".join(character if " " <= character <= "~" or character == "·" else "?" for character in text)
    if width is None or font(size).getlength(text) <= width:
        return text
    while text and font(size).getlength(text + "...") > width:
        text = text[:-1]
    return text.rstrip() + "..."


def number(value: float, span: float | None = None) -> str:
    """A number as short as it can be told: a whole one without decimals, else three digits that count.

    ``span`` gives the decimals instead: enough to tell values apart that differ by a hundredth of it.
    """
    if span is not None:
        decimals = min(5, max(0, 2 - math.floor(math.log10(span)))) if span > 0 else 3
        return f"{value:,.{decimals}f}"
    if value == 0:
        return "0"
    if value == round(value):
        return f"{value:,.0f}"
    size = abs(value)
    decimals = 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 else 3
    return f"{value:,.{decimals}f}" if size >= 0.001 else f"{value:.2g}"
