import numpy as np
import pytest
from scipy.stats import binomtest
from see2act.statistics import average_precision, difference_interval, wilson


@pytest.mark.parametrize(("successes", "attempts"), [(0, 25), (7, 25), (25, 25), (312, 400)])
def test_wilson_agrees_with_scipy(successes: int, attempts: int) -> None:
    expected = binomtest(successes, attempts).proportion_ci(method="wilson")
    assert wilson(successes, attempts) == pytest.approx((expected.low, expected.high))


def test_no_attempts_say_nothing() -> None:
    assert wilson(0, 0) == (0.0, 1.0)


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="5 successes of 4 attempts"):
        wilson(5, 4)


def test_difference_agrees_with_newcombe_s_example() -> None:
    """Newcombe 1998, table II, contrast (a), method 10."""
    assert difference_interval(56, 70, 48, 80) == pytest.approx((0.0524, 0.3339), abs=1e-4)


def test_average_precision_is_the_mean_precision_at_each_label() -> None:
    scores = np.array([[[0.9, 0.8, 0.7, 0.6, 0.1]]], np.float32)
    labels = np.array([[[True, False, True, False, True]]])
    assert average_precision(scores, labels) == pytest.approx((1 / 1 + 2 / 3 + 3 / 5) / 3)
    assert average_precision(labels.astype(np.float32), labels) == 1
    rng = np.random.default_rng(0)
    many = rng.random((4, 50, 50)) < 0.1
    assert average_precision(rng.random(many.shape, np.float32), many) == pytest.approx(0.1, abs=0.02)


def test_average_precision_forgives_small_shifts() -> None:
    labels = np.zeros((1, 40, 40), bool)
    labels[0, 10:30, 20] = True
    shifted = np.roll(labels, 2, axis=2).astype(np.float32)
    assert average_precision(shifted, labels, tolerance=2) == 1
    assert average_precision(shifted, labels, tolerance=1) < 0.1
    assert average_precision(np.ones_like(shifted), labels, tolerance=2) == pytest.approx(0.064, abs=0.01)


def test_average_precision_without_labels_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one label"):
        average_precision(np.zeros((1, 4, 4), np.float32), np.zeros((1, 4, 4), bool))
