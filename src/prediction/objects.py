"""What stands above the floor or the empty bin, and may be an object."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from see2act.robot.heightmap import CRACK

STATIC = 0.005
"""Metres above the floor, or the background, that are not an object yet."""
SMALLEST = 1e-4
"""Square metres of the smallest object as seen from above: 1 cm by 1 cm. What is smaller is noise of the sensor."""
SEEN = 0.9
"""Share of what is under a suction cup that must be seen: it leaks where there is nothing."""


def known(seen: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where there is a reading, or a crack between readings; not where there are readings on one side alone."""
    side = 2 * round(CRACK) + 1
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, ellipse) > 0)


def standing(
    height: Float[np.ndarray, "H W"], under: Float[np.ndarray, "H W"], there: Bool[np.ndarray, "H W"], pixel: float
) -> Int[np.ndarray, "H W"]:
    """Connected parts of a heightmap that stand above what was there before, numbered from 1; 0 for no part.

    An object is a part, or, where objects touch, shares a part with others.

    Args:
        height: Metres above the floor.
        under: The same of the empty bin: zeros where only its floor is known.
        there: Where the height is known.
        pixel: Metres a pixel.
    """
    # A reading of a wall may lie in the next pixel of the background.
    parts, count = ndimage.label(there & (height - ndimage.maximum_filter(under, size=3) > STATIC))
    large = np.bincount(parts.ravel(), minlength=count + 1) * pixel**2 >= SMALLEST
    large[0] = False
    return np.asarray(np.where(large, np.cumsum(large), 0)[parts])


def sealable(there: Bool[np.ndarray, "H W"], radius: float, pixel: float) -> Bool[np.ndarray, "H W"]:
    """Where what is under a round cup is seen.

    Args:
        there: Where the height is known.
        radius: Of the cup, metres.
        pixel: Metres a pixel.
    """
    reach = int(radius / pixel)
    rows, cols = np.mgrid[-reach : reach + 1, -reach : reach + 1] * pixel
    cup = np.hypot(rows, cols) <= radius
    return np.asarray(ndimage.convolve(there.astype(np.float32), cup / cup.sum(), mode="constant") > SEEN - 1e-6)
