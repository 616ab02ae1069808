"""From many values to the few that a chart can show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

MOST_POINTS = 300
"""Points of a line; of more values, these are taken evenly, the first and the last included."""
MOST_BINS = 60
EPISODES_PER_BIN = 15
"""At least so many on average, so that percentiles say something."""
LOW_PERCENT, HIGH_PERCENT = 10, 90


def running_means(values: Sequence[float], window: int) -> list[float]:
    """Mean of the newest values, at most ``window``, after each.

    Examples:
        >>> running_means([1.0, 3.0, 5.0], 2)
        [1.0, 2.0, 4.0]
    """
    sums = np.concatenate([[0.0], np.cumsum(np.asarray(values, np.float64))])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - window, 0)
    return [float(mean) for mean in (sums[ends] - sums[begins]) / (ends - begins)]


def thinned(count: int, most: int = MOST_POINTS) -> list[int]:
    """Indices of at most ``most`` of ``count`` values, evenly.

    Examples:
        >>> thinned(3), thinned(5, 3)
        ([0, 1, 2], [0, 2, 4])
    """
    if count <= most:
        return list(range(count))
    return sorted({round(place) for place in np.linspace(0, count - 1, most)})


def percentiles_by_bin(
    x: Sequence[float], y: Sequence[float], last_x: float
) -> tuple[list[float], list[float], list[float], list[float]]:
    """The middles of equal bins of x that hold values, and their 10th, 50th and 90th percentiles."""
    count = max(1, min(MOST_BINS, len(x) // EPISODES_PER_BIN))
    bins = np.minimum((np.asarray(x, np.float64) * count / max(last_x, 1.0)).astype(np.int64), count - 1)
    values = np.asarray(y, np.float64)
    found = sorted(set(bins.tolist()))
    middles = [(number + 0.5) * last_x / count for number in found]
    low, middle, high = (
        [float(np.percentile(values[bins == number], percent)) for number in found]
        for percent in (LOW_PERCENT, 50, HIGH_PERCENT)
    )
    return middles, low, middle, high


def on_grid(x: Sequence[float], y: Sequence[float], grid: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values of a line at given places by linear interpolation; NaN outside of it."""
    return np.interp(grid, x, y, left=np.nan, right=np.nan)
