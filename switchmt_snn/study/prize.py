"""The largest prize that a switching policy could win: the best split of a number of steps over the tasks.

It rests on one assumption, which makes it an estimate: what a task scores depends on its own steps only. Then a policy
decides nothing but how many steps each task gets, and the best split can be read off the tasks' learning curves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ConfigError
from switchmt_snn.study.statistics import harmonic_mean_over_tasks, share_of_reference

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TaskCurve:
    """What a task scores after so many steps of its own.

    Attributes:
        steps_N: rising, above 0.
        scores_N: raw score at each; between two it is read off the line between them.
        floor: raw score without any steps, as random play's.
        reference: raw score that counts as 1.
    """

    steps_N: Array
    scores_N: Array
    floor: float
    reference: float

    @classmethod
    def of_episodes(
        cls, lengths_steps: Sequence[int], returns: Sequence[float], window: int, floor: float, reference: float
    ) -> TaskCurve:
        """The curve of a run's training returns: the best mean so far over ``window`` successive episodes.

        "Best so far" because a policy may stop where a task was best; it is biased upwards, by less the longer the
        window.

        Args:
            lengths_steps: agent steps of every episode of the task, in order.
            returns: their raw returns.
            window: episodes of a mean.
            floor: as the attribute.
            reference: as the attribute.

        Raises:
            ConfigError: fewer episodes than the window.
        """
        if len(returns) < window or window < 1:
            raise ConfigError(f"{len(returns)} episodes, expected at least the {window} of a window, and a window")
        means = np.convolve(np.asarray(returns, np.float64), np.full(window, 1.0 / window), "valid")
        steps = np.cumsum(np.asarray(lengths_steps, np.float64))[window - 1 :]
        return cls(steps, np.maximum.accumulate(np.maximum(means, floor)), floor, reference)

    @property
    def longest_steps(self) -> int:
        """Steps up to which the curve is known."""
        return int(self.steps_N[-1])

    def share(self, steps: npt.ArrayLike) -> Array:
        """``share_of_reference`` after so many steps of the task; any shape."""
        known_steps, known = np.append(0.0, self.steps_N), np.append(self.floor, self.scores_N)
        scores = np.interp(np.asarray(steps, np.float64), known_steps, known)
        shares = share_of_reference(scores.reshape(-1, 1), [self.reference], [self.floor])
        return shares.reshape(scores.shape)


@dataclass(frozen=True)
class Split:
    """Steps of each task, the shares of their references there, and the shares' harmonic mean."""

    steps_K: tuple[int, ...]
    shares_K: tuple[float, ...]
    harmonic_mean: float


def split_of(curves: Sequence[TaskCurve], steps_K: Sequence[int]) -> Split:
    """What a split comes to.

    Raises:
        ConfigError: not one number of steps per curve, or one that a curve is not known for.
    """
    if len(steps_K) != len(curves) or any(steps > c.longest_steps for steps, c in zip(steps_K, curves, strict=True)):
        known = ", ".join(f"{curve.longest_steps:,}" for curve in curves)
        raise ConfigError(f"a split of {list(steps_K)} steps, expected for each curve at most what it knows ({known})")
    shares = [float(curve.share(steps)) for curve, steps in zip(curves, steps_K, strict=True)]
    return Split(tuple(steps_K), tuple(shares), float(harmonic_mean_over_tasks([shares])[0]))


def best_split(curves: Sequence[TaskCurve], budget_steps: int, parts: int = 60) -> Split:
    """The split of ``budget_steps`` with the largest harmonic mean of shares, in units of a part of the budget.

    A split is left out where a task would get more steps than its curve knows: nothing is extrapolated. A task whose
    curve cannot rise any more gets what is left over in the split that is found first.

    Examples:
        >>> fast = TaskCurve(np.array([10.0, 90.0]), np.array([1.0, 1.0]), 0.0, 1.0)
        >>> slow = TaskCurve(np.array([90.0]), np.array([0.9]), 0.0, 1.0)
        >>> best_split([fast, slow], 100, parts=10).steps_K
        (10, 90)

    Raises:
        ConfigError: no curve, or no split for which all curves are known.
    """
    if not curves:
        raise ConfigError("no curve, expected at least one")
    unit = budget_steps / parts
    splits = [
        (*first, parts - sum(first))
        for first in itertools.product(range(parts + 1), repeat=len(curves) - 1)
        if sum(first) <= parts
    ]
    steps_GK = np.asarray(splits, np.float64) * unit
    known = (steps_GK <= [curve.longest_steps for curve in curves]).all(axis=-1)
    if not known.any():
        longest = ", ".join(f"{curve.longest_steps:,}" for curve in curves)
        raise ConfigError(
            f"no split of {budget_steps:,} steps that the curves know ({longest} steps), expected fewer steps, or runs "
            "that are longer"
        )
    steps_GK = steps_GK[known]
    shares_GK = np.stack([curve.share(steps) for curve, steps in zip(curves, steps_GK.T, strict=True)], axis=-1)
    best = int(np.argmax(harmonic_mean_over_tasks(shares_GK)))
    return split_of(curves, [int(steps) for steps in steps_GK[best]])
