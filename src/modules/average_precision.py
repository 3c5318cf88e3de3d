"""The measure of how good a vision model is at its task."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float


def average_precision(scores: Float[np.ndarray, "n H W"], labels: Bool[np.ndarray, "n H W"], tolerance: int = 0) -> float:
    """Average precision over all pixels: the area under the precision-recall curve, with a tolerance for positions.

    A prediction is correct if it is within ``tolerance`` pixels of a label. The score of a label is the highest score within
    ``tolerance`` pixels of it. Without a tolerance this is the usual average precision.

    Raises:
        ValueError: No pixel is labelled.
    """
    if not labels.any():
        raise ValueError("average precision needs at least one label")
    side = np.arange(-tolerance, tolerance + 1)
    disc = (side[:, None] ** 2 + side**2 <= tolerance**2).astype(np.uint8)
    right = np.stack([cv2.dilate(label.astype(np.uint8), disc) for label in labels]).ravel() > 0
    found = np.stack([cv2.dilate(score, disc, borderValue=-math.inf) for score in scores.astype(np.float32)])[labels]
    order = np.argsort(-scores, axis=None)
    descending, hits = scores.ravel()[order], np.cumsum(right[order])
    count = np.searchsorted(-descending, -found, side="right")  # pixels with at least this score
    return float((hits[count - 1] / count).mean())
