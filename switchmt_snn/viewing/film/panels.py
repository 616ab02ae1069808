"""The parts of a frame: each draws one thing of a moment into its box."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from switchmt_snn.tasks.suite import Frames
from switchmt_snn.viewing.film.canvas import (
    CHOSEN,
    GAIN,
    GROUND,
    LARGE,
    LINE,
    LOSS,
    MUTED,
    NORMAL,
    PANEL,
    SMALL,
    SPIKE,
    TEXT,
    TITLE,
    VALUE,
    Box,
    Canvas,
    font,
    number,
)
from switchmt_snn.viewing.film.layout import GAINS_LINE, GAINS_LINE_COMPACT, GAINS_TITLE, RATES_LINE, RATES_TITLE
from switchmt_snn.viewing.film.moments import Moment
from switchmt_snn.viewing.film.raster import TimeAxis, raster_pixels

LABEL, BELOW = 18, 6
"""Heights of a raster's title and of what is left free below it."""


@dataclass(frozen=True)
class Past:
    """What a frame still shows of an earlier decision."""

    drawn: dict[str, npt.NDArray[np.bool_]]
    """Spikes of the drawn neurons ``[T, R]`` by layer."""
    rates: dict[str, float]
    q_A: npt.NDArray[np.float32]
    value: float | None
    reward: float
    begins: bool


@dataclass(frozen=True)
class Names:
    """What does not change during a film of a task.

    Attributes:
        task: name.
        actions: by index of a Q-value.
        valid_A: which of them exist.
        about: the agent, the part that stays where there is little room last.
        gains: of the dendrites by stream ``[N]`` or ``[1]``.
        rows: indices of the drawn neurons by layer.
        neurons: of each layer.
        spiking: whether neurons spike; else those that are not zero are drawn.
    """

    task: str
    actions: tuple[str, ...]
    valid_A: npt.NDArray[np.bool_]
    about: tuple[str, ...]
    gains: dict[str, npt.NDArray[np.float32]]
    rows: dict[str, npt.NDArray[np.int64]]
    neurons: dict[str, int]
    spiking: bool


@dataclass
class Seen:
    """The newest moment of a task and those before it, as far as they are still shown."""

    moment: Moment
    past: deque[Past] = field(default_factory=deque)


def draw_head(canvas: Canvas, box: Box, names: Names, moment: Moment, compact: bool) -> None:
    """Task and agent; score, episode and step."""
    score = number(moment.score)
    canvas.text((box.right, box.top - 6), score, LARGE, anchor="ra")
    label = f"score, {signed(moment.reward)} now" if moment.reward else "score"
    canvas.text((box.right, box.top + 38), label, SMALL, MUTED, "ra")
    where = f"episode {moment.episode} · step {moment.step:,}"
    canvas.text((box.left, box.top), names.task, TITLE, width=box.width - 150)
    line = f"{where} · {names.about[-1] if compact else ', '.join(names.about)}"
    canvas.text((box.left, box.top + 34), line, SMALL, MUTED, width=box.width - 110)


def draw_game(canvas: Canvas, box: Box, moment: Moment) -> None:
    """The picture of the game; else what the network sees of it."""
    canvas.fill(box, PANEL, 6)
    inner = box.inner(8)
    if moment.picture is not None:
        height, width = moment.picture.shape[:2]
        canvas.paste(moment.picture, inner, smooth=min(height, width) > 250)
    elif moment.frame.ndim == 3:
        canvas.paste(grey(moment.frame), inner)
    else:
        _draw_features(canvas, inner, moment.frame)
    if moment.ended is not None:
        bar = Box(box.left, box.bottom - 34, box.width, 34)
        canvas.fill(bar, GROUND)
        how = "cut off" if moment.ended.truncated else "over"
        text = f"episode {how}: {number(moment.ended.score)}"
        canvas.text((bar.left + bar.width / 2, bar.top + 17), text, NORMAL, anchor="mm")


def grey(frame: Frames) -> npt.NDArray[np.uint8]:
    """The brightest channel of an image ``[c, H, W]`` as ``[H, W, 3]``."""
    image = frame.max(axis=0).astype(np.float64)
    largest = 255.0 if image.max() > 1 else 1.0
    return np.repeat((255 * image / largest).astype(np.uint8)[:, :, None], 3, axis=2)


def _draw_features(canvas: Canvas, box: Box, features: Frames) -> None:
    """The observation's numbers, for a task without a picture."""
    title, rest = box.cut_top(LABEL)
    canvas.text((title.left, title.top), "observation (no picture)", SMALL, MUTED, width=title.width)
    high = max(1, min(18, rest.height // max(1, len(features))))
    for index, value in enumerate(features[: rest.height // high].tolist()):
        top = rest.top + index * high
        canvas.text((rest.left, top), str(index), SMALL, MUTED)
        canvas.text((rest.left + 110, top), number(value), SMALL, anchor="ra")


def draw_gains(canvas: Canvas, box: Box, names: Names, compact: bool) -> None:
    """A line from 0 to 1 for each stream: a tick for every neuron's gain, a dot at their mean."""
    canvas.fill(box, PANEL, 6)
    inner = Box(box.left + 10, box.top + 6, box.width - 20, box.height - 8)
    top, high = inner.top, GAINS_LINE_COMPACT if compact else GAINS_LINE
    if not compact:
        canvas.text((inner.left, inner.top), "gains of the dendrites, 0 to 1", SMALL, MUTED)
        top += GAINS_TITLE - 8
    left, right = inner.left + 120, inner.right - 96
    for index, (stream, gains_N) in enumerate(names.gains.items()):
        middle = top + index * high + high // 2 - 1
        canvas.text((inner.left, middle), f"gain, {stream}" if compact else stream, SMALL, anchor="lm", width=116)
        canvas.line([(left, middle), (right, middle)], LINE, 2)
        places = left + gains_N * (right - left)
        for x in np.unique(places.round()).tolist():
            canvas.line([(x, middle - 5), (x, middle + 5)], GAIN, 1)
        canvas.dot(float(places.mean()), middle, 5, TEXT)
        shown = number(float(gains_N.mean()))
        if len(gains_N) > 1:
            shown = f"{gains_N.min():.2f} to {gains_N.max():.2f}"
        canvas.text((inner.right, middle), shown, SMALL, anchor="rm")


def draw_values(canvas: Canvas, box: Box, names: Names, seen: Seen, compact: bool) -> None:
    """Q by action on one axis; the state's value as a line, so that a stem is an advantage."""
    canvas.fill(box, PANEL, 6)
    inner = box.inner(10)
    moment, exists = seen.moment, np.flatnonzero(names.valid_A)
    chosen = names.actions[moment.action]
    title, rest = inner.cut_top(LABEL, 4)
    canvas.text((title.left, title.top), "Q-values", SMALL, MUTED)
    how = f"at random: {chosen}" if moment.random else f"chosen: {chosen}"
    canvas.text((title.right, title.top), how, SMALL, CHOSEN, "ra", width=title.width - 64)
    below = 40 if compact else 66
    high = min(34, (rest.height - below) // len(exists))
    size = NORMAL if high >= 20 else SMALL if high >= 14 else 11
    longest = max(font(size).getlength(names.actions[action]) for action in exists.tolist())
    name_wide = min(math.ceil(longest), rest.width // 2 - 40)
    left, right = rest.left + name_wide + 8, rest.right - 56
    low, top = _span(seen.past)
    insight = moment.insight

    def across(value: float) -> float:
        return left + (value - low) / (top - low) * (right - left)

    bottom = rest.top + high * len(exists)
    for row, action in enumerate(exists.tolist()):
        middle = rest.top + row * high + high / 2
        is_chosen, q = action == moment.action, float(insight.q_A[action])
        if is_chosen:
            canvas.fill(Box(rest.left - 4, rest.top + row * high, rest.width + 8, high), LINE, 3)
        colour = CHOSEN if is_chosen else TEXT
        canvas.text((rest.left, middle), names.actions[action], size, colour, "lm", width=name_wide)
        canvas.line([(left, middle), (right, middle)], GROUND if is_chosen else LINE, 1)
        if insight.value is not None:
            canvas.line([(across(insight.value), middle), (across(q), middle)], colour, 3)
        if is_chosen and moment.random:
            canvas.diamond(across(q), middle, 6, CHOSEN)
        else:
            canvas.dot(across(q), middle, 5 if is_chosen else 3.5, colour)
        canvas.text((rest.right, middle), number(q, top - low), size, colour, "rm")
    if insight.value is not None:
        x = across(insight.value)
        canvas.line([(x, rest.top), (x, bottom)], VALUE, 2)
    _draw_below_values(canvas, Box(left, bottom, right - left, below), rest.left, names, moment, (low, top), compact)


def _draw_below_values(
    canvas: Canvas,
    box: Box,
    names_left: int,
    names: Names,
    moment: Moment,
    span: tuple[float, float],
    compact: bool,
) -> None:
    """The axis' ends, and value and advantage as numbers."""
    value, advantage_A, wide = moment.insight.value, moment.insight.advantage_A, span[1] - span[0]
    canvas.text((box.left, box.top + 4), number(span[0], wide), SMALL, MUTED)
    canvas.text((box.right, box.top + 4), number(span[1], wide), SMALL, MUTED, "ra")
    if value is not None and compact:
        canvas.text((box.left + box.width / 2, box.top + 20), f"value {number(value, wide)}", SMALL, VALUE, "ma")
    if value is None or advantage_A is None or compact:
        return
    left, right = names_left, box.right + 56
    canvas.text((left, box.top + 28), "value (line)", SMALL, VALUE)
    canvas.text((right, box.top + 28), number(value, wide), SMALL, VALUE, "ra")
    advantage = float(advantage_A[moment.action])
    canvas.text((left, box.top + 46), f"advantage of {names.actions[moment.action]}", SMALL, CHOSEN, width=180)
    canvas.text((right, box.top + 46), signed(advantage, wide), SMALL, CHOSEN, "ra")


def _span(past: Sequence[Past]) -> tuple[float, float]:
    """The smallest and the largest Q of the decisions that are shown, with room at both ends."""
    finite = [one.q_A[np.isfinite(one.q_A)] for one in past]
    values = [one.value for one in past if one.value is not None]
    low = min([*values, *(float(q.min()) for q in finite)])
    high = max([*values, *(float(q.max()) for q in finite)])
    room = 0.06 * (high - low) or 0.5
    return low - room, high + room


def draw_spikes(canvas: Canvas, box: Box, names: Names, seen: Seen, axis: TimeAxis, compact: bool) -> None:
    """A raster for each layer; in a compact frame with the firing rate."""
    if not names.rows:
        canvas.fill(box, PANEL, 6)
        middle = (box.left + box.width / 2, box.top + box.height / 2)
        canvas.text(middle, "what plays here does not show its neurons", SMALL, MUTED, "mm")
        return
    for name, raster in raster_boxes(box, tuple(names.rows)).items():
        rate = seen.past[-1].rates[name]
        top = raster.top - LABEL - 1
        word = "rate" if names.spiking else "active"
        about = f"{len(names.rows[name])} of {names.neurons[name]:,} neurons"
        canvas.text((box.left, top), name, NORMAL)
        canvas.text((box.left + 76, top + 1), about, SMALL, MUTED)
        if compact:
            canvas.text((box.right, top), f"{word} {rate:.3f}", SMALL, anchor="ra")
        pixels = raster_pixels([past.drawn[name] for past in seen.past], axis, raster)
        canvas.paste_exactly(pixels, axis.left, raster.top)


def draw_rates(canvas: Canvas, box: Box, names: Names, seen: Seen) -> None:
    """The firing rate of each layer as a bar, and its range over the decisions that are shown as a line below."""
    canvas.fill(box, PANEL, 6)
    inner = box.inner(10)
    word = "firing rate, spikes per neuron and step" if names.spiking else "share of neurons that are not zero"
    canvas.text((inner.left, inner.top), word, SMALL, MUTED, width=inner.width)
    left, right = inner.left + 70, inner.right - 50
    largest = max(rate for past in seen.past for rate in past.rates.values()) or 1.0
    for row, (name, rate) in enumerate(seen.past[-1].rates.items()):
        top = inner.top + RATES_TITLE - 12 + row * RATES_LINE
        rates = [past.rates[name] for past in seen.past]
        ends = [left + value / largest * (right - left) for value in (rate, min(rates), max(rates))]
        canvas.text((inner.left, top + 7), name, SMALL, anchor="lm", width=66)
        canvas.fill(Box(left, top, right - left, 10), LINE)
        canvas.fill(Box(left, top, max(1, round(ends[0]) - left), 10), SPIKE)
        canvas.line([(ends[1], top + 13), (ends[2], top + 13)], MUTED, 2)
        canvas.text((inner.right, top + 7), f"{rate:.3f}", SMALL, anchor="rm")


def raster_boxes(box: Box, layers: Sequence[str]) -> dict[str, Box]:
    """Where each layer's raster lies within the box of all."""
    each = box.height // len(layers)
    return {
        name: Box(box.left, box.top + index * each + LABEL + 1, box.width, each - LABEL - 1 - BELOW)
        for index, name in enumerate(layers)
    }


def draw_trace(canvas: Canvas, box: Box, seen: Seen, axis: TimeAxis, compact: bool) -> None:
    """Value (or the largest Q) over time, rewards below it, and lines where episodes begin."""
    title, rest = box.cut_top(LABEL)
    curve, marks = rest.cut_top(rest.height - 16, 2)
    canvas.fill(rest, PANEL)
    valued = seen.moment.insight.value is not None
    shown = [one.value if one.value is not None else float(one.q_A[np.isfinite(one.q_A)].max()) for one in seen.past]
    low, high = min(shown), max(shown)
    if low == high:
        low, high = low - 0.5, high + 0.5
    name = "value" if valued else "largest Q"
    canvas.text((title.left, title.top), f"{name} {number(shown[-1])}", SMALL, VALUE)
    span = f"{number(min(shown))} to {number(max(shown))}"
    canvas.text((title.left + 120, title.top), span, SMALL, MUTED)
    _draw_legend(canvas, title, compact)
    for back, past in enumerate(reversed(seen.past)):
        x = axis.middle(back)
        if past.begins:
            canvas.line([(axis.start(back) - 1, rest.top), (axis.start(back) - 1, rest.bottom - 1)], MUTED, 1)
        if past.reward:
            up = past.reward > 0
            canvas.triangle(x, marks.top + 6, 5, GAIN if up else LOSS, up)
    _draw_curve(canvas, curve.inner(3), axis, shown, (low, high), VALUE)


def _draw_legend(canvas: Canvas, title: Box, compact: bool) -> None:
    """Forms of rewards."""
    if compact and title.width < 420:
        return
    x = title.right - 150
    canvas.triangle(x, title.top + 8, 5, GAIN, up=True)
    canvas.text((x + 10, title.top), "reward", SMALL, MUTED)
    canvas.triangle(x + 76, title.top + 8, 5, LOSS, up=False)
    canvas.text((x + 86, title.top), "penalty", SMALL, MUTED)


def _draw_curve(
    canvas: Canvas,
    box: Box,
    axis: TimeAxis,
    values: Sequence[float],
    span: tuple[float, float],
    colour: tuple[int, int, int],
) -> None:
    low, high = span
    points = [
        (axis.middle(back), box.bottom - 1 - (value - low) / (high - low) * (box.height - 1))
        for back, value in enumerate(reversed(values))
    ]
    if len(points) > 1:
        canvas.line(points, colour, 2)
    canvas.dot(*points[0], 2.5, colour)


def signed(value: float, span: float | None = None) -> str:
    """A number with its sign."""
    return f"+{number(value, span)}" if value > 0 else number(value, span)
