"""Statistics of many runs: what a few seeds of a few tasks say, and how surely.

Shapes: S seeds, K tasks, N points of a learning curve. Statistics of scores take ``[..., S, K]`` and give ``[...]``, so
that a bootstrap computes all of its resamples at once. Interquartile mean, stratified bootstrap, probability of
improvement and performance profiles are those of Agarwal et al. 2021 (arXiv 2108.13264) and give its library's numbers
(``tests/study/test_statistics.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ConfigError

Array = npt.NDArray[np.float64]

RESAMPLES = 10_000
"""Resamples of a bootstrap: the ends of a 95 % interval then differ by about 1 % of its width between two seeds."""
_NUMBERS_AT_A_TIME = 2**21
"""Scores that a bootstrap holds at a time (16 MiB)."""
_EXACT_SEEDS = 16
"""Up to this many seeds a test goes through all of the 2^S signs; above it draws as many at random."""


@dataclass(frozen=True)
class Interval:
    """A statistic and its confidence interval.

    Attributes:
        value: of the scores as they are.
        low: lower end.
        high: upper end.
        confidence: share of intervals, made in this way, that contain the true value.
    """

    value: float
    low: float
    high: float
    confidence: float


def interquartile_mean(scores_SK: npt.ArrayLike) -> Any:
    """Mean of the middle half of all S x K scores: ``floor(S K / 4)`` are left out at each end.

    Examples:
        >>> float(interquartile_mean([[0.0, 1.0], [2.0, 30.0]]))
        1.5

    Raises:
        ConfigError: scores that are no finite numbers ``[..., S, K]``.
    """
    scores = _scores(scores_SK)
    ordered = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def mean_score(scores_SK: npt.ArrayLike) -> Any:
    """Mean of all S x K scores.

    Raises:
        ConfigError: scores that are no finite numbers ``[..., S, K]``.
    """
    return _scores(scores_SK).mean(axis=(-2, -1))


def probability_of_improvement(scores_SK: npt.ArrayLike, other_SK: npt.ArrayLike) -> Any:
    """Probability that a run of the first method beats one of the other on a task drawn at random; a tie counts half.

    Per task, the share of the S x S' pairs of runs that the first wins (Mann-Whitney's U / (S S')); then the mean over
    tasks. Pairs are across all seeds, also when the seeds are paired.

    Examples:
        >>> float(probability_of_improvement([[2.0], [3.0]], [[1.0], [2.0]]))
        0.875

    Raises:
        ConfigError: scores that are no finite numbers ``[..., S, K]``, or another number of tasks.
    """
    scores, other = _scores(scores_SK), _scores(other_SK)
    _same_tasks(scores, other)
    won = scores[..., :, None, :] > other[..., None, :, :]
    tied = scores[..., :, None, :] == other[..., None, :, :]
    return (won + 0.5 * tied).mean(axis=(-3, -2, -1))


def performance_profile(scores_SK: npt.ArrayLike, thresholds: Sequence[float] | Array) -> Array:
    """Share of the S x K scores above each threshold.

    Returns:
        ``[..., len(thresholds)]``.

    Raises:
        ConfigError: scores that are no finite numbers ``[..., S, K]``.
    """
    scores = _scores(scores_SK)
    flat = scores.reshape(*scores.shape[:-2], 1, -1)
    return np.asarray((flat > np.asarray(thresholds, np.float64)[:, None]).mean(axis=-1), np.float64)


def share_of_reference(
    scores_SK: npt.ArrayLike, references_K: Sequence[float], floors_K: Sequence[float] | None = None
) -> Array:
    """``min((score - floor) / (reference - floor), 1)``: what a task can contribute is capped at its reference.

    Args:
        scores_SK: raw scores.
        references_K: score of each task that counts as 1, as a single-task run's with the same network and steps.
        floors_K: score of each task that counts as 0, as random play's; 0 if left out. A task whose reference is 0 or
            below (Pong) needs one.

    Returns:
        ``[..., S, K]``; below 0 where a score is below its floor.

    Raises:
        ConfigError: not one reference per task, or one that is not above its floor.
    """
    scores = _scores(scores_SK)
    references = np.asarray(references_K, np.float64)
    floors = np.zeros_like(references) if floors_K is None else np.asarray(floors_K, np.float64)
    if references.shape != scores.shape[-1:] or floors.shape != references.shape:
        raise ConfigError(
            f"{references.size} references and {floors.size} floors for {scores.shape[-1]} tasks, expected one of each "
            "per task"
        )
    if not (np.isfinite(references).all() and np.isfinite(floors).all() and (references > floors).all()):
        raise ConfigError(
            f"references {references.tolist()} with floors {floors.tolist()}, expected every reference above its "
            "floor; name as floor what random play scores"
        )
    return np.minimum((scores - floors) / (references - floors), 1.0)


def minimum_over_tasks(shares_SK: npt.ArrayLike) -> Any:
    """The worst task of each seed, ``[..., S]``; give it ``share_of_reference``.

    Raises:
        ConfigError: shares that are no finite numbers ``[..., S, K]``.
    """
    return _scores(shares_SK).min(axis=-1)


def harmonic_mean_over_tasks(shares_SK: npt.ArrayLike) -> Any:
    """Harmonic mean over each seed's tasks, ``[..., S]``; 0 if one of its tasks is at 0 or below.

    Give it ``share_of_reference``. A method that gives up one task loses more than it can win on the others.

    Examples:
        >>> float(harmonic_mean_over_tasks([[1.0, 0.5, 0.25]])[0])
        0.42857142857142855

    Raises:
        ConfigError: shares that are no finite numbers ``[..., S, K]``.
    """
    shares = _scores(shares_SK)
    lost = (shares <= 0).any(axis=-1)
    return np.where(lost, 0.0, 1.0 / (1.0 / np.where(shares > 0, shares, 1.0)).mean(axis=-1))


def area_under_curve(steps_N: Sequence[float] | Array, scores_N: npt.ArrayLike) -> Any:
    """Mean height of a learning curve: its area by the trapezoid rule, divided by the steps that it spans.

    Args:
        steps_N: step of each evaluation, rising; N at least 2.
        scores_N: ``[..., N]``.

    Examples:
        >>> float(area_under_curve([0, 10, 30], [0.0, 1.0, 1.0]))
        0.8333333333333334

    Raises:
        ConfigError: steps that do not rise, another number of scores, or a score that is no finite number.
    """
    steps, scores = np.asarray(steps_N, np.float64), _finite(scores_N, "scores [..., N]", dimensions=1)
    if steps.ndim != 1 or steps.size < 2 or (np.diff(steps) <= 0).any() or scores.shape[-1] != steps.size:
        raise ConfigError(
            f"a curve of {scores.shape[-1]} scores at steps {steps.tolist()}, expected at least 2 rising steps and one "
            "score at each"
        )
    return np.trapezoid(scores, steps, axis=-1) / (steps[-1] - steps[0])


def forgetting(scores_N: npt.ArrayLike) -> Any:
    """Best earlier score minus the final one; below 0 if the final one is the best.

    A maximum over noisy evaluations is above the true best: compare it between methods evaluated alike, with the same
    number of points and episodes.

    Args:
        scores_N: ``[..., N]``, one task's evaluations in the order of training; N at least 2.

    Examples:
        >>> float(forgetting([1.0, 5.0, 4.0]))
        1.0

    Raises:
        ConfigError: fewer than 2 scores, or one that is no finite number.
    """
    scores = _finite(scores_N, "scores [..., N]", dimensions=1)
    if scores.shape[-1] < 2:
        raise ConfigError(f"forgetting of {scores.shape[-1]} score, expected at least 2 evaluations of a task")
    return scores[..., :-1].max(axis=-1) - scores[..., -1]


def bootstrap_interval(
    statistic: Callable[..., Any],
    *scores_SK: npt.ArrayLike,
    paired: bool = False,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Percentile interval of a statistic by a bootstrap that is stratified: seeds are drawn anew within each task.

    Args:
        statistic: takes as many score arrays ``[..., S, K]`` as are given, and returns ``[...]``: a function of this
            module, or one composed of them.
        scores_SK: one array, or several methods' on the same tasks.
        paired: draw the same seeds for all methods. For a difference between methods with paired seeds; then the
            seeds are drawn once for all tasks, as a seed's tasks belong to one run.
        confidence: of the interval.
        resamples: number of bootstrap samples.
        seed: of the draws; the same seed gives the same interval.

    Raises:
        ConfigError: scores that are no finite numbers ``[S, K]``, fewer than 2 seeds (they say nothing about other
            seeds), other tasks, or paired methods with another number of seeds.
    """
    arrays = [_scores(scores) for scores in scores_SK]
    _check_bootstrap(arrays, paired, confidence, resamples)
    rngs = [np.random.default_rng((seed, number)) for number in range(len(arrays))]
    at_a_time = max(1, _NUMBERS_AT_A_TIME // max(_work(arrays), 1))
    values = []
    for start in range(0, resamples, at_a_time):
        count = min(at_a_time, resamples - start)
        values.append(np.asarray(statistic(*_resampled(arrays, count, paired, rngs)), np.float64).reshape(count))
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(np.concatenate(values), [tail, 100.0 - tail])
    return Interval(float(statistic(*arrays)), float(low), float(high), confidence)


def sign_flip_test(differences_S: Sequence[float] | Array, seed: int = 0) -> float:
    """Two-sided p-value of "no difference" for paired seeds.

    Without a difference, each seed's difference could as well have had the other sign. The p-value is the share of all
    2^S sign patterns whose mean difference is at least as far from 0 as the one seen. It cannot be below 2 / 2^S.
    Above 16 seeds, 2^16 patterns are drawn at random, and the pattern seen is counted as one of them.

    Examples:
        >>> sign_flip_test([1.0, 2.0, 3.0])
        0.25

    Raises:
        ConfigError: fewer than 2 differences, or one that is no finite number.
    """
    differences = _finite(differences_S, "differences [S]", dimensions=1)
    if differences.ndim != 1 or differences.size < 2:
        raise ConfigError(f"differences of shape {differences.shape}, expected one per seed, of at least 2 seeds")
    seeds = differences.size
    if seeds <= _EXACT_SEEDS:
        patterns = (np.arange(2**seeds)[:, None] >> np.arange(seeds)) & 1
    else:
        patterns = np.random.default_rng(seed).integers(0, 2, (2**_EXACT_SEEDS, seeds))
        patterns[0] = 0
    sums = np.abs((1 - 2 * patterns) @ differences)
    rounding = 1e-12 * float(np.abs(differences).sum())  # patterns of equal sums differ by the order of the addition
    return float((sums >= abs(differences.sum()) - rounding).mean())


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down p-values: comparing each with alpha keeps the chance of any false claim at alpha.

    The i-th smallest of m (from 0) is multiplied by m - i, made at least as large as the one before, and capped at 1.

    Examples:
        >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]

    Raises:
        ConfigError: a value outside [0, 1].
    """
    p = np.asarray(p_values, np.float64)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise ConfigError(f"p-values {p.tolist()}, expected numbers within [0, 1]")
    order = np.argsort(p, kind="stable")
    adjusted = np.minimum(np.maximum.accumulate(p[order] * (p.size - np.arange(p.size))), 1.0)
    result = np.empty_like(p)
    result[order] = adjusted
    return [float(value) for value in result]


def _resampled(arrays: list[Array], count: int, paired: bool, rngs: list[np.random.Generator]) -> list[Array]:
    """Bootstrap samples ``[count, S, K]`` of each array; draws of each do not depend on the pieces."""
    if paired:
        seeds = rngs[0].integers(0, len(arrays[0]), (count, len(arrays[0])))
        return [array[seeds] for array in arrays]
    drawn = []
    for array, rng in zip(arrays, rngs, strict=True):
        seeds = rng.integers(0, len(array), (count, *array.shape))
        drawn.append(array[seeds, np.arange(array.shape[1])])
    return drawn


def _work(arrays: list[Array]) -> int:
    """Numbers that a statistic of one sample may hold: the scores, or every pair of two methods' seeds."""
    seeds = [len(array) for array in arrays]
    return int(arrays[0].shape[1]) * max(sum(seeds), seeds[0] * seeds[-1] if len(seeds) > 1 else 0)


def _check_bootstrap(arrays: list[Array], paired: bool, confidence: float, resamples: int) -> None:
    if not arrays:
        raise ConfigError("a bootstrap of no scores, expected at least one array [S, K]")
    for array in arrays:
        if array.ndim != 2 or len(array) < 2:
            raise ConfigError(f"scores of shape {array.shape}, expected [S, K] with at least 2 seeds for an interval")
        _same_tasks(arrays[0], array)
        if paired and len(array) != len(arrays[0]):
            raise ConfigError(f"{len(arrays[0])} and {len(array)} paired seeds, expected the same seeds of both")
    if not 0 < confidence < 1:
        raise ConfigError(f"a confidence of {confidence}, expected within (0, 1), as 0.95")
    if resamples < 1:
        raise ConfigError(f"{resamples} resamples, expected at least 1")


def _same_tasks(scores: Array, other: Array) -> None:
    if scores.shape[-1] != other.shape[-1]:
        raise ConfigError(f"scores of {scores.shape[-1]} and of {other.shape[-1]} tasks, expected the same tasks")


def _scores(values: npt.ArrayLike) -> Array:
    return _finite(values, "scores [S, K], seeds by tasks", dimensions=2)


def _finite(values: npt.ArrayLike, expected: str, dimensions: int) -> Array:
    array = np.asarray(values, np.float64)
    if array.ndim < dimensions or array.size == 0:
        raise ConfigError(f"an array of shape {array.shape}, expected {expected}")
    if not np.isfinite(array).all():
        raise ConfigError(
            f"{int((~np.isfinite(array)).sum())} of {array.size} scores are no finite numbers, expected {expected}; "
            "leave runs that failed out, and say so"
        )
    return array
