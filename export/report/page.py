"""``report.html``: one self-contained page about one or several profiles; every number comes from ``profile.json``."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from PIL import Image

from switchmt_snn.drawing.chart import WIDE, Chart, picture_of
from switchmt_snn.drawing.marks import SERIES_COLOURS, series_colour
from switchmt_snn.drawing.numbers import digits, scaled
from switchmt_snn.drawing.page import FILTERS as PAGE_FILTERS
from switchmt_snn.drawing.page import page_environment
from switchmt_snn.drawing.rows import LogRows, rows_picture
from switchmt_snn.drawing.svg import inline_svg
from switchmt_snn.export.report.figures import energy_figure, rates_figures, spikes_figure

Frames = Sequence[npt.NDArray[Any]]
"""Frames of each task's stretch of play, ``[n, *frame_shape]``."""

_LAYER_COLOURS = tuple(f"var(--{series_colour(index)})" for index in range(SERIES_COLOURS))
"""A layer's colour in every chart."""
_CHANNEL_COLOURS = np.array(
    [(38, 70, 83), (42, 157, 143), (233, 196, 106), (231, 111, 81), (120, 80, 160), (90, 160, 220), (150, 150, 150)],
    np.uint8,
)
NARROW = 360.0
"""Width of a figure on a phone, in pixels."""
_PAPER, _BAND, _SPIKE = 255, 238, 20


def render_report(runs: list[dict[str, Any]], frames: Sequence[Frames], command: str) -> str:
    """The page.

    Args:
        runs: contents of ``profile.json``, one per run.
        frames: for each run, the frames of each task's stretch of play (empty without).
        command: what made it.
    """
    environment = page_environment("switchmt_snn.export.report")
    environment.filters |= FILTERS
    environment.globals |= FILTERS | {"colours": _LAYER_COLOURS, "raster": _raster, "picture": _picture}
    environment.globals |= {"energy_figure": energy_figure, "spikes_figure": spikes_figure, "drawn": _drawn}
    environment.globals |= {
        "rates_figures": rates_figures,
        "panel": _panel,
        "chip_rows": chip_rows,
        "energies": energies,
    }
    return environment.get_template("report.html.jinja").render(
        runs=list(zip(runs, frames, strict=True)), command=command
    )


def microjoule(value_pj: float) -> str:
    """Picojoule as microjoule."""
    return digits(value_pj / 1e6)


def energy(value_pj: float) -> str:
    """An energy in the unit that fits, not to be broken between lines."""
    return scaled(value_pj * 1e-12, "J").replace(" ", "\u00a0")


def energies(smallest_pj: float, largest_pj: float) -> str:
    """A range of energies; a unit that both have is written once."""
    low, high = energy(smallest_pj), energy(largest_pj)
    if low == high:
        return high
    number, unit = low.split()
    return f"{number if high.split()[1] == unit else low} to {high}"


def power(value_uw: float) -> str:
    """A power in the unit that fits."""
    return scaled(value_uw * 1e-6, "W").replace(" ", "\u00a0")


FILTERS = PAGE_FILTERS | {filter.__name__: filter for filter in (microjoule, energy, power)}


def chip_rows(run: dict[str, Any]) -> list[dict[str, Any]]:
    """What a decision costs on each chip and whether the chip can hold the network, a row per chip.

    ``cost`` is None where no energy is published, ``fit`` where the chip's limits are not known, ``same_actions`` where
    the chip's rounded weights were not tried.
    """
    costs, fits = run["summary"]["chips"], {chip["title"]: chip for chip in run["chips"]}
    rows = []
    for name in dict.fromkeys([*costs, *fits]):
        fit = fits.get(name)
        shares = [
            effect["equal_actions_share"]
            for task in run["tasks"]
            for effect in task.get("precision", ())
            if fit is not None and fit["fits"] and effect["bits"] == fit["weight_bits"]
        ]
        same = {"smallest": min(shares), "largest": max(shares)} if shares else None
        rows.append({"name": name, "cost": costs.get(name), "fit": fit, "same_actions": same})
    return rows


def _panel(chart: Chart) -> Markup:
    """One of several charts side by side."""
    return Markup(inline_svg(picture_of(chart)))


def _drawn(figure: LogRows) -> Markup:
    """A figure in two widths, of which the page shows the one that fits."""
    widths = {"wide": WIDE, "narrow": NARROW}
    return Markup("").join(Markup(inline_svg(rows_picture(figure, width), name)) for name, width in widths.items())


def _raster(layer: dict[str, Any], timesteps: int) -> str:
    """A layer's spikes as an image: a row per neuron, a column per simulation step, decisions as bands."""
    spikes = np.array([[mark == "1" for mark in row] for row in layer["spikes"]], np.bool_)
    steps = spikes.shape[1]
    paper = np.where(np.arange(steps) // timesteps % 2, _BAND, _PAPER).astype(np.uint8)
    return _encoded(np.where(spikes, np.uint8(_SPIKE), paper))


def _picture(frame: npt.NDArray[Any]) -> str:
    """A grey frame ``[1, H, W]``, or one of binary channels ``[C, H, W]``, each in its colour."""
    if len(frame) == 1:
        return _encoded(frame[0])
    shown = np.full((*frame.shape[1:], 3), _PAPER, np.uint8)
    for channel, present in enumerate(frame):
        shown[present > 0] = _CHANNEL_COLOURS[channel % len(_CHANNEL_COLOURS)]
    return _encoded(shown)


def _encoded(pixels: npt.NDArray[np.uint8]) -> str:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()
