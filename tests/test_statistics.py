import pytest
from scipy.stats import binomtest
from see2act.statistics import difference_interval, wilson


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
