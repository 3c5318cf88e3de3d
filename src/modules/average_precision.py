"""How good a vision model is at its task."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float


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
