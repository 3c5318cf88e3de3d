"""Numbers with their uncertainty."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float
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


def average_precision(scores: Float[np.ndarray, "n H W"], labels: Bool[np.ndarray, "n H W"], tolerance: int = 0) -> float:
    """Area under precision over recall of all pixels together, with a tolerance for where a label lies.

    A pixel counts as right within ``tolerance`` pixels of a label, and a label as found by the best score within
    ``tolerance`` pixels. Without a tolerance this is the usual average precision.

    Raises:
        ValueError: There is no label.
    """
    if not labels.any():
        raise ValueError("average precision needs at least one label")
    side = np.arange(-tolerance, tolerance + 1)
    disc = (side[:, None] ** 2 + side**2 <= tolerance**2).astype(np.uint8)
    right = np.stack([cv2.dilate(label.astype(np.uint8), disc) for label in labels]).ravel() > 0
    found = np.stack([cv2.dilate(score, disc, borderValue=-math.inf) for score in scores.astype(np.float32)])[labels]
    order = np.argsort(-scores, axis=None)
    descending, hits = scores.ravel()[order], np.cumsum(right[order])
    count = np.searchsorted(-descending, -found, side="right")  # pixels that score at least as much
    return float((hits[count - 1] / count).mean())
