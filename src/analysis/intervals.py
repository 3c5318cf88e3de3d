"""Means, differences and probabilities of improvement over seeds, with 95 % intervals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from see2act.experiment.results import wilson
from see2act.seeding import generator

NOTHING = 1e-12
"""A spread of rates that is no more than rounding."""
RESAMPLES = 2000
"""Draws of a bootstrap: its 95 % limits are then good to about a hundredth of the distribution."""


def difference_interval(successes: int, attempts: int, others: int, their_attempts: int) -> tuple[float, float]:
    """95 % interval of the difference of two independent binomial rates (Newcombe 1998, method 10)."""
    a, b = (n / max(1, of) for n, of in ((successes, attempts), (others, their_attempts)))
    (low_a, high_a), (low_b, high_b) = wilson(successes, attempts), wilson(others, their_attempts)
    return a - b - math.hypot(a - low_a, high_b - b), a - b + math.hypot(high_a - a, b - low_b)


def mean_interval(rates: Sequence[float]) -> tuple[float, float] | None:
    """95 % t interval of the mean of independent rates, cut to [0, 1]; None for fewer than two, which have no spread."""
    if (interval := t_interval(rates)) is None:
        return None
    return max(0.0, interval[0]), min(1.0, interval[1])


def t_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """95 % t interval of the mean of independent values; None for fewer than two."""
    if len(values) < 2:
        return None
    if np.ptp(values) < NOTHING:  # scipy divides by the spread
        return float(values[0]), float(values[0])
    interval = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(interval.low), float(interval.high)


def mean_difference_interval(a: Sequence[float], b: Sequence[float]) -> tuple[float, float] | None:
    """95 % interval of the difference of two means, ``a`` less ``b``, with unequal variances (Welch 1947).

    None where either has fewer than two values.
    """
    if min(len(a), len(b)) < 2:
        return None
    if max(np.ptp(a), np.ptp(b)) < NOTHING:  # scipy divides by the spread
        difference = float(np.mean(a) - np.mean(b))
        return difference, difference
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # one of them may have no spread
        interval = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    return float(interval.low), float(interval.high)


def interquartile_mean(scores: Float[np.ndarray, "*samples n"]) -> Float[np.ndarray, "*samples"]:
    """Mean of the middle half along the last axis: a quarter of the values, rounded down, is cut off at each end."""
    middle: np.ndarray = stats.trim_mean(scores, 0.25, axis=-1)
    return middle


def interquartile_interval(strata: Sequence[Float[np.ndarray, "seeds scores"]]) -> tuple[float, float]:
    """95 % stratified bootstrap interval of the interquartile mean of all scores together.

    Seeds are drawn with replacement within each stratum, each with all of its scores, which are not independent.
    """
    rng = generator("bootstrap/interquartile mean")
    drawn = [s[rng.integers(len(s), size=(RESAMPLES, len(s)))].reshape(RESAMPLES, -1) for s in strata]
    return _middle_95(interquartile_mean(np.concatenate(drawn, axis=1)))


def improvement(a: Float[np.ndarray, "*samples n"], b: Float[np.ndarray, "*samples m"]) -> Float[np.ndarray, "*samples"]:
    """Probability of improvement, P(A > B), over all pairs of a seed of ``a`` and one of ``b``; a tie counts half."""
    left, right = a[..., :, None], b[..., None, :]
    share: np.ndarray = ((left > right) + 0.5 * (left == right)).mean(axis=(-2, -1))
    return share


def improvement_interval(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> tuple[float, float]:
    """95 % bootstrap interval of :func:`improvement`: the seeds of each are drawn with replacement."""
    rng = generator("bootstrap/improvement")
    drawn = [x[rng.integers(len(x), size=(RESAMPLES, len(x)))] for x in (a, b)]
    return _middle_95(improvement(*drawn))


def _middle_95(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
