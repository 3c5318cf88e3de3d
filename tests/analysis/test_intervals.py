import numpy as np
import pytest
from scipy import stats

from see2act.analysis.intervals import (
    difference_interval,
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    mean_difference_interval,
    mean_interval,
    t_interval,
)
from see2act.experiment.results import wilson


def test_wilson_agrees_with_newcombe_s_examples() -> None:
    """Newcombe 1998 (one proportion), table I, method 3."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=1e-4)


def test_no_attempts_say_nothing() -> None:
    assert wilson(0, 0) == (0.0, 1.0)


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="5 successes of 4 attempts"):
        wilson(5, 4)


def test_difference_agrees_with_newcombe_s_example() -> None:
    """Newcombe 1998, table II, contrast (a), method 10."""
    assert difference_interval(56, 70, 48, 80) == pytest.approx((0.0524, 0.3339), abs=1e-4)


def test_the_interval_of_a_mean_is_student_s_cut_to_what_a_rate_can_be() -> None:
    rates = [0.4, 0.55, 0.5, 0.6, 0.45]
    half = 2.7764 * 0.079057 / 5**0.5  # the 97.5 % point of t with 4 degrees of freedom, and the sample's deviation
    assert mean_interval(rates) == pytest.approx((0.5 - half, 0.5 + half), abs=1e-4)
    assert mean_interval([0.7, 0.7]) == (0.7, 0.7)
    assert mean_interval([0.9, 1.0]) == pytest.approx((0.95 - 12.7062 * 0.05, 1.0), abs=1e-4)
    assert mean_interval([0.7]) is None


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    assert interquartile_mean(np.array([1.0, 0.0, 0.2, 0.1, 0.3, 0.6, 0.4, 0.5])) == pytest.approx(0.35)
    scores = np.random.default_rng(0).random((3, 11))
    assert interquartile_mean(scores) == pytest.approx(np.sort(scores, axis=1)[:, 2:-2].mean(axis=1))


def test_the_bootstrap_of_one_stratum_agrees_with_scipy_s() -> None:
    scores = np.random.default_rng(1).random(12)
    theirs = stats.bootstrap(
        (scores,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    low, high = interquartile_interval([scores[:, None]])
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=0.02)
    assert interquartile_interval([scores[:, None]]) == (low, high)


def test_seeds_are_drawn_within_their_stratum_and_with_all_their_scores() -> None:
    assert interquartile_interval([np.full((3, 2), 0.2), np.full((3, 2), 0.8)]) == pytest.approx((0.5, 0.5))
    good_or_bad = np.array([[0.0, 0.0], [1.0, 1.0]])  # a seed is good in all scenes or in none
    assert interquartile_interval([good_or_bad]) == (0.0, 1.0)


def test_the_probability_of_improvement_counts_pairs() -> None:
    a, b = np.array([0.1, 0.5, 0.9]), np.array([0.5, 0.2])
    assert improvement(a, b) == pytest.approx((0 + 0 + 0.5 + 1 + 1 + 1) / 6)
    assert improvement(b, a) == pytest.approx(1 - 3.5 / 6)
    n, m = np.random.default_rng(3).normal(size=(2, 8))
    assert improvement(n, m) == pytest.approx(stats.mannwhitneyu(n, m).statistic / 64)
    low, high = improvement_interval(a, b)
    assert 0 <= low <= improvement(a, b) <= high <= 1
    assert improvement_interval(a, b) == (low, high)
    assert improvement_interval(a, a - 1) == (1.0, 1.0)


def test_a_rate_lies_within_its_interval_despite_rounding() -> None:
    for n in range(1, 80):
        for successes in range(n + 1):
            low, high = wilson(successes, n)
            assert 0 <= low <= successes / n <= high <= 1


def test_the_difference_of_means_has_welch_s_interval() -> None:
    a, b = [0.9, 0.8, 0.7], [0.5, 0.1, 0.2, 0.4]
    left, right = 0.01 / 3, 0.1 / 3 / 4  # variances of the means
    freedom = (left + right) ** 2 / (left**2 / 2 + right**2 / 3)
    half = stats.t.ppf(0.975, freedom) * (left + right) ** 0.5
    assert mean_difference_interval(a, b) == pytest.approx((0.5 - half, 0.5 + half))
    assert mean_difference_interval([1, 1], [0.5, 0.5, 0.5]) == (0.5, 0.5)
    assert mean_difference_interval([1], [0.5, 0.5]) is None


def test_changes_may_be_negative() -> None:
    low, high = t_interval([-0.2, -0.1, -0.3]) or (0, 0)
    assert (low + high) / 2 == pytest.approx(-0.2)
    assert low < -0.4
