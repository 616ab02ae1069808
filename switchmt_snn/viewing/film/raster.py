"""The spikes of a layer over the last decisions, as pixels: a row per neuron, a column per simulation step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from switchmt_snn.viewing.film.canvas import LINE, PANEL, SPIKE, Box

SHOWN_DECISIONS = 32
"""Decisions that a raster shows at least, if a column is wider than a pixel."""
WIDEST_STEP_PIXELS = 8
LEAST_PIXELS_WITH_GAP = 3
"""Steps that are as wide leave a pixel free, so that two spikes in a row are two."""


@dataclass(frozen=True)
class TimeAxis:
    """Where decisions and their simulation steps lie: the newest decision at the right, a pixel between two.

    Attributes:
        left: first column of pixels.
        width: in pixels.
        timesteps: simulation steps of a decision, at least 1.
    """

    left: int
    width: int
    timesteps: int

    @property
    def step_pixels(self) -> int:
        """Width of a simulation step."""
        fits = (self.width // SHOWN_DECISIONS - 1) // self.timesteps
        return max(1, min(WIDEST_STEP_PIXELS, fits))

    @property
    def decision_pixels(self) -> int:
        """Width of a decision, with the pixel that follows it."""
        return self.step_pixels * self.timesteps + 1

    @property
    def decisions(self) -> int:
        """How many decisions are shown."""
        return max(1, self.width // self.decision_pixels)

    def start(self, back: int) -> int:
        """First column of the decision that is ``back`` decisions before the newest."""
        return self.left + self.width - (back + 1) * self.decision_pixels

    def middle(self, back: int) -> float:
        """The middle of a decision."""
        return self.start(back) + (self.decision_pixels - 1) / 2

    def column(self, back: int, step: int) -> int:
        """First column of a simulation step of a decision."""
        return self.start(back) + step * self.step_pixels


def row_pixels(height: int) -> int:
    """Height of a neuron's row in a raster of some height."""
    return 4 if height >= 160 else 3


def rows_that_fit(height: int) -> int:
    """Neurons that a raster of some height shows."""
    return max(1, height // row_pixels(height))


def raster_pixels(history: Sequence[npt.NDArray[np.bool_]], axis: TimeAxis, box: Box) -> npt.NDArray[np.uint8]:
    """A raster ``[box.height, axis.width, 3]``.

    Args:
        history: spikes of the drawn neurons ``[T, R]``, a decision each, the newest last; at most ``axis.decisions``.
        axis: where decisions lie.
        box: where the raster is drawn.
    """
    high = row_pixels(box.height)
    pixels = np.empty((box.height, axis.width, 3), np.uint8)
    pixels[:] = PANEL
    for back, fired_TR in enumerate(reversed(history)):
        start = axis.start(back) - axis.left
        if start < 0:
            break
        pixels[:, start - 1 : start] = LINE  # between two decisions; nothing before column 0
        wide_RC = np.repeat(fired_TR.T, axis.step_pixels, axis=1)
        if axis.step_pixels >= LEAST_PIXELS_WITH_GAP:
            wide_RC[:, axis.step_pixels - 1 :: axis.step_pixels] = False  # a pixel between two steps
        tall_HC = np.repeat(wide_RC, high, axis=0)[: box.height]
        tall_HC[high - 1 :: high] = False  # a pixel between two rows
        block = pixels[: len(tall_HC), start : start + tall_HC.shape[1]]
        block[tall_HC] = SPIKE
    return pixels
