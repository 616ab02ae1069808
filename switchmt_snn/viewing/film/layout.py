"""Where the parts of a task's panel lie: one task beside its network, several as columns."""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.viewing.film.canvas import Box

WIDTH, HEIGHT = 1280, 720
COLUMN = 480
"""Least width of a task's column."""
MARGIN, GAP = 20, 14
FOOT = 26
RATES_TITLE, RATES_LINE = 34, 23
GAINS_TITLE, GAINS_LINE, GAINS_LINE_COMPACT = 26, 30, 20


@dataclass(frozen=True)
class Layout:
    """Boxes of one task.

    Attributes:
        head: names, score, episode.
        game: the picture.
        gains: of the dendrites.
        values: Q-values by action.
        rates: firing rates of all layers; None if they stand above the rasters only.
        spikes: rasters of all layers, one above the other.
        trace: value and rewards over time, below the rasters and as wide.
        compact: leave out titles and lines that only repeat a number.
    """

    head: Box
    game: Box
    gains: Box
    values: Box
    rates: Box | None
    spikes: Box
    trace: Box
    compact: bool


def canvas_size(tasks: int) -> tuple[int, int]:
    """Width and height of a film in pixels; both even, as video needs."""
    return max(WIDTH, tasks * COLUMN), HEIGHT


def layouts(tasks: int, streams: int, layers: int) -> tuple[Layout, ...]:
    """The layout of each task; ``streams`` have dendrites and ``layers`` show spikes, so that gains and
    rates need a line each."""
    width, height = canvas_size(tasks)
    if tasks == 1:
        return (_beside(Box(0, 0, width, height - FOOT), streams, layers),)
    column = width // tasks
    return tuple(_column(Box(i * column, 0, column, height - FOOT), streams) for i in range(tasks))


def _beside(box: Box, streams: int, layers: int) -> Layout:
    head, rest = box.inner(MARGIN).cut_top(60, GAP)
    left, rest = rest.cut_left(372, GAP)
    middle, right = rest.cut_left(530, GAP)
    values, rates = right.cut_top(right.height - RATES_TITLE - RATES_LINE * layers - GAP, GAP)
    below = GAINS_TITLE + GAINS_LINE * streams if streams else 0
    game, gains = left.cut_top(left.height - below - (GAP if streams else 0), GAP if streams else 0)
    spikes, trace = middle.cut_top(middle.height - 96 - GAP, GAP)
    return Layout(head, game, gains, values, rates if layers else None, spikes, trace, compact=False)


def _column(box: Box, streams: int) -> Layout:
    gap = 8
    head, rest = box.inner(12).cut_top(56, gap)
    top, rest = rest.cut_top(256, gap)
    game, values = top.cut_left(200 if box.width < 600 else 260, gap)
    below = GAINS_LINE_COMPACT * streams + 8 if streams else 0
    rest, gains = rest.cut_top(rest.height - below - (gap if streams else 0), gap if streams else 0)
    spikes, trace = rest.cut_top(rest.height - 58 - gap, gap)
    return Layout(head, game, gains, values, None, spikes, trace, compact=True)
