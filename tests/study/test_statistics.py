"""Statistics of many runs, against numbers of other libraries and by hand.

``RLIABLE`` was computed once, with rliable 1.2.0 (arch 7.2.0, NumPy 2.4.6, SciPy 1.17.1) in an environment of its own::

    from rliable import library, metrics
    metrics.aggregate_iqm(A), metrics.aggregate_mean(A), metrics.probability_of_improvement(A, B)
    both = lambda x: np.array([metrics.aggregate_iqm(x), metrics.aggregate_mean(x)])
    library.get_interval_estimates({"A": A, "B": B}, both, reps=50000, random_state=np.random.RandomState(0))
    library.get_interval_estimates({"p": (A, B)}, metrics.probability_of_improvement, reps=5000, random_state=...)
    library.create_performance_profile({"A": A}, THRESHOLDS, reps=10)

The p-values are of ``scipy.stats.permutation_test(..., permutation_type="samples", n_resamples=np.inf)`` and of
``statsmodels.stats.multitest.multipletests(..., method="holm")`` (statsmodels 0.15.0).
"""

from __future__ import annotations

import numpy as np
import pytest

from switchmt_snn.errors import ConfigError
from switchmt_snn.study.statistics import (
    area_under_curve,
    bootstrap_interval,
    forgetting,
    harmonic_mean_over_tasks,
    holm,
    interquartile_mean,
    mean_score,
    minimum_over_tasks,
    performance_profile,
    probability_of_improvement,
    share_of_reference,
    sign_flip_test,
)

A = np.array([[1.2, 0.4, 7.5], [0.9, 0.6, 9.1], [1.5, 0.5, 8.2], [1.1, 0.3, 6.4], [1.3, 0.8, 9.9]])
B = np.array([[1.0, 0.4, 6.1], [1.1, 0.2, 8.8], [0.7, 0.5, 7.0], [0.9, 0.6, 5.2], [1.2, 0.3, 9.0]])
THRESHOLDS = [0.0, 0.4, 0.5, 1.0, 7.0, 9.9]
RLIABLE = {
    "iqm": (2.3666666666666667, 1.9222222222222218),
    "mean": (3.313333333333334, 2.866666666666666),
    "iqm_95": ((2.1666666666666665, 2.7444444444444445), (1.7555555555555555, 2.411111111111111)),
    "mean_95": ((2.9466666666666668, 3.6733333333333333), (2.4266666666666667, 3.2999999999999994)),
    "improvement": 0.7266666666666666,
    "improvement_95": (0.5266666666666667, 0.8933333333333332),
    "profile": [1.0, 0.8666666666666667, 0.8, 0.6, 0.26666666666666666, 0.0],
}


def test_point_estimates_equal_rliables() -> None:
    for number, scores in enumerate((A, B)):
        assert interquartile_mean(scores) == pytest.approx(RLIABLE["iqm"][number], rel=1e-14)
        assert mean_score(scores) == pytest.approx(RLIABLE["mean"][number], rel=1e-14)
    assert probability_of_improvement(A, B) == pytest.approx(RLIABLE["improvement"], rel=1e-14)
    assert probability_of_improvement(B, A) == pytest.approx(1 - RLIABLE["improvement"], rel=1e-14)
    assert performance_profile(A, THRESHOLDS).tolist() == pytest.approx(RLIABLE["profile"], rel=1e-14)


def test_intervals_equal_rliables_up_to_the_draws() -> None:
    """Both are of random draws; the ends of 50,000 resamples differ by less than 2 % of the width between seeds."""
    for name, statistic in (("iqm_95", interquartile_mean), ("mean_95", mean_score)):
        for scores, (low, high) in zip((A, B), RLIABLE[name], strict=True):
            found = bootstrap_interval(statistic, scores, resamples=50_000)
            assert found.value == statistic(scores)
            assert (found.low, found.high) == pytest.approx((low, high), abs=0.02 * (high - low))
    low, high = RLIABLE["improvement_95"]
    found = bootstrap_interval(probability_of_improvement, A, B)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


def test_strata_are_the_tasks() -> None:
    """Rows drawn whole keep a task's scores with the other tasks'; drawn within tasks, they mix."""
    one_good_task_each = np.array([[0.0, 1.0], [1.0, 0.0]])
    found = bootstrap_interval(mean_score, one_good_task_each, confidence=0.5, resamples=4000)
    assert (found.low, found.high) == (0.25, 0.75)
    paired = bootstrap_interval(mean_score, one_good_task_each, paired=True, resamples=4000)
    assert (paired.low, paired.high) == (0.5, 0.5), "each run has the mean 0.5"


def test_paired_seeds_are_drawn_together() -> None:
    """A difference that every seed shows has no spread, however far the seeds are apart."""

    def difference(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return mean_score(x) - mean_score(y)

    better = B + 0.25
    paired = bootstrap_interval(difference, better, B, paired=True, resamples=500)
    assert (paired.low, paired.high) == pytest.approx((0.25, 0.25))
    independent = bootstrap_interval(difference, better, B, resamples=500)
    assert independent.low < 0 < independent.high


def test_an_interval_is_the_same_for_the_same_seed_and_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    scores, other = np.random.default_rng(5).normal(size=(2, 7, 3))
    first = bootstrap_interval(probability_of_improvement, scores, other, resamples=301)
    assert bootstrap_interval(probability_of_improvement, scores, other, resamples=301) == first
    assert bootstrap_interval(mean_score, scores) != bootstrap_interval(mean_score, scores, seed=1)
    monkeypatch.setattr("switchmt_snn.study.statistics._NUMBERS_AT_A_TIME", 1000)
    assert bootstrap_interval(probability_of_improvement, scores, other, resamples=301) == first


def test_an_interval_covers_the_true_value_about_as_often_as_it_says() -> None:
    """Ten seeds of three tasks with normal noise; the percentile bootstrap is known to be a little too narrow."""
    rng = np.random.default_rng(0)
    covered = 0
    for number in range(200):
        found = bootstrap_interval(mean_score, rng.normal(size=(10, 3)), resamples=400, seed=number)
        covered += found.low <= 0.0 <= found.high
    assert 0.85 <= covered / 200 <= 0.99


def test_shares_of_references_and_what_is_made_of_them() -> None:
    shares = share_of_reference([[2.0, 5.0], [8.0, 1.0]], references_K=[4.0, 10.0])
    assert shares.tolist() == [[0.5, 0.5], [1.0, 0.1]]
    assert minimum_over_tasks(shares).tolist() == [0.5, 0.1]
    assert harmonic_mean_over_tasks(shares).tolist() == pytest.approx([0.5, 2 / 11])
    pong = share_of_reference([[-20.7], [-17.3], [-13.9], [20.0], [-21.0]], [-13.9], floors_K=[-20.7])
    assert pong[:, 0].tolist() == pytest.approx([0.0, 0.5, 1.0, 1.0, -0.3 / 6.8])
    assert harmonic_mean_over_tasks([[0.0, 1.0], [-0.1, 1.0]]).tolist() == [0.0, 0.0]


def test_statistics_take_many_samples_at_once() -> None:
    many = np.stack([A, B, A[::-1]])
    assert interquartile_mean(many).tolist() == [interquartile_mean(scores) for scores in many]
    assert probability_of_improvement(many, A[None]).tolist() == [probability_of_improvement(x, A) for x in many]
    assert performance_profile(many, THRESHOLDS).tolist() == [performance_profile(x, THRESHOLDS).tolist() for x in many]
    assert harmonic_mean_over_tasks(many).shape == (3, 5)


def test_area_and_forgetting_of_curves() -> None:
    steps = [0.0, 10.0, 40.0]
    assert area_under_curve(steps, [0.0, 2.0, 2.0]) == pytest.approx((10 * 1 + 30 * 2) / 40)
    assert area_under_curve(steps, [[3.0, 3.0, 3.0], [0.0, 0.0, 4.0]]).tolist() == pytest.approx([3.0, 1.5])
    assert forgetting([1.0, 9.0, 4.0, 6.0]) == 3.0
    assert forgetting([[1.0, 2.0, 5.0], [5.0, 2.0, 1.0]]).tolist() == [-3.0, 4.0]


def test_p_values_equal_scipys_and_statsmodels() -> None:
    assert sign_flip_test((A - B).mean(axis=1)) == 0.0625
    assert sign_flip_test([0.3, -0.1, 0.4, 0.2, 0.1, 0.5, -0.2, 0.35]) == 0.0859375
    assert sign_flip_test([0.1, 0.2, -0.3]) == 1.0, "the sum 0 is rounded; every pattern is as far from 0"
    assert holm([0.01, 0.04, 0.03, 0.005, 0.2]) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.2])
    assert holm([]) == []


def test_p_values_of_more_seeds_than_can_be_enumerated() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=16)
    exact = sign_flip_test(noise)
    assert sign_flip_test(np.append(noise, 0.0)) == pytest.approx(exact, abs=0.01), "a seed without a difference"
    assert sign_flip_test(np.ones(40)) == 1 / 2**16, "the pattern seen counts, so that no p-value is 0"


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda: interquartile_mean([1.0, 2.0]), r"shape \(2,\), expected scores \[S, K\]"),
        (lambda: interquartile_mean([[1.0, np.nan]]), "1 of 2 scores are no finite numbers"),
        (lambda: probability_of_improvement(A, B[:, :2]), "3 and of 2 tasks, expected the same tasks"),
        (lambda: share_of_reference(A, [1.0, 2.0]), "2 references and 2 floors for 3 tasks"),
        (lambda: share_of_reference(A, [1.0, -2.0, 3.0]), "expected every reference above its floor"),
        (lambda: bootstrap_interval(mean_score, A[:1]), r"shape \(1, 3\), .* at least 2 seeds"),
        (lambda: bootstrap_interval(mean_score), "a bootstrap of no scores"),
        (lambda: bootstrap_interval(mean_score, A, confidence=95), "a confidence of 95, expected within"),
        (lambda: bootstrap_interval(mean_score, A, resamples=0), "0 resamples"),
        (lambda: bootstrap_interval(probability_of_improvement, A, B[:4], paired=True), "5 and 4 paired seeds"),
        (lambda: area_under_curve([0, 0, 1], [1, 2, 3]), "expected at least 2 rising steps"),
        (lambda: area_under_curve([0, 1], [1, 2, 3]), "a curve of 3 scores"),
        (lambda: forgetting([1.0]), "forgetting of 1 score"),
        (lambda: sign_flip_test([1.0]), "expected one per seed, of at least 2"),
        (lambda: holm([0.5, 1.5]), "expected numbers within"),
    ],
)
def test_what_is_no_score_is_refused_in_one_line(call, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        call()
    assert "\n" not in str(caught.value)
