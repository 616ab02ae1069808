"""The best split of a budget, against splits known by hand and by another search."""

from __future__ import annotations

import numpy as np
import pytest

from switchmt_snn.errors import ConfigError
from switchmt_snn.study.prize import TaskCurve, best_split, split_of


def line(longest: float, slope: float, reference: float = 1.0, floor: float = 0.0) -> TaskCurve:
    """A task whose score rises evenly with its steps."""
    return TaskCurve(np.array([longest]), np.array([floor + slope * longest]), floor, reference)


def test_lines_of_equal_slope_share_evenly_and_a_slow_one_gets_more() -> None:
    assert best_split([line(100, 0.005), line(100, 0.005)], 100, parts=10).steps_K == (50, 50)
    # shares a x and b (B - x): the harmonic mean is largest where x / (B - x) = sqrt(b / a), here 1 to 2
    found = best_split([line(300, 0.002), line(300, 0.0005)], 300, parts=30)
    assert found.steps_K == (100, 200)
    assert found.shares_K == pytest.approx((0.2, 0.1))
    assert found.harmonic_mean == pytest.approx(2 / (1 / 0.2 + 1 / 0.1))


def test_the_best_split_beats_every_other_one() -> None:
    rng = np.random.default_rng(3)
    curves = [
        TaskCurve(
            np.cumsum(rng.uniform(5, 20, 12)), np.cumsum(rng.uniform(0, 2, 12)) - 5, -5.0, float(rng.uniform(1, 9))
        )
        for _ in range(3)
    ]
    budget = 90
    found = best_split(curves, budget, parts=30)
    others = []
    for a in range(0, budget + 1, 3):
        for b in range(0, budget + 1 - a, 3):
            steps = (a, b, budget - a - b)
            if all(count <= curve.longest_steps for count, curve in zip(steps, curves, strict=True)):
                others.append(split_of(curves, steps).harmonic_mean)
    assert len(others) > 50
    assert found.harmonic_mean == pytest.approx(max(others))


def test_a_curve_of_episodes_is_the_best_mean_so_far_and_starts_at_the_floor() -> None:
    curve = TaskCurve.of_episodes([10, 10, 10, 10, 10], [0, 2, 4, 2, 0], window=2, floor=-1.0, reference=9.0)
    assert curve.steps_N.tolist() == [20, 30, 40, 50]
    assert curve.scores_N.tolist() == [1, 3, 3, 3]
    assert curve.longest_steps == 50
    assert curve.share([0, 20, 25, 50]) == pytest.approx(np.array([0.0, 0.2, 0.3, 0.4]))


def test_nothing_is_extrapolated() -> None:
    short = line(20, 0.01)
    assert best_split([short, line(100, 0.01)], 100, parts=10).steps_K == (20, 80)
    with pytest.raises(ConfigError, match="no split of 100 steps"):
        best_split([short, line(50, 0.01)], 100)
    with pytest.raises(ConfigError, match="expected for each curve at most"):
        split_of([short], [21])
    with pytest.raises(ConfigError, match="at least the 3 of a window"):
        TaskCurve.of_episodes([1, 1], [0.0, 1.0], window=3, floor=0, reference=1)
