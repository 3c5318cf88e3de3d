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
