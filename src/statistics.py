"""Numbers with their uncertainty."""

from __future__ import annotations

import math

from scipy.stats import norm


def wilson(successes: int, attempts: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a binomial rate (Wilson 1927); (0, 1) without attempts.

    Raises:
        ValueError: More successes than attempts, or a negative count.
    """
    if not 0 <= successes <= attempts:
        raise ValueError(f"{successes} successes of {attempts} attempts are impossible")
    if attempts == 0:
        return 0.0, 1.0
    z = float(norm.ppf((1 + confidence) / 2))
    rate = successes / attempts
    centre = rate + z * z / (2 * attempts)
    half = z * math.sqrt(rate * (1 - rate) / attempts + z * z / (4 * attempts * attempts))
    scale = 1 + z * z / attempts
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def difference_interval(successes: int, attempts: int, others: int, their_attempts: int) -> tuple[float, float]:
    """95 % interval of the difference of two independent binomial rates (Newcombe 1998, method 10)."""
    a, b = (n / max(1, of) for n, of in ((successes, attempts), (others, their_attempts)))
    (low_a, high_a), (low_b, high_b) = wilson(successes, attempts), wilson(others, their_attempts)
    return a - b - math.hypot(a - low_a, high_b - b), a - b + math.hypot(high_a - a, b - low_b)
