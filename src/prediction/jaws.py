"""Whether the fingers of a gripper come down beside what they are to hold, as a heightmap shows it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

SLACK = 0.005
"""Metres by which something may be higher than a fingertip: so much gives way, or is noise of the sensor."""


def blocked(
    height: Float[np.ndarray, "H W"],
    fingertip: Float[np.ndarray, "H W"],
    angles: int,
    inner: float,
    outer: tuple[float, float],
    pixel: float,
) -> Bool[np.ndarray, "A H W"]:
    """Where a grasp would put a finger on something: on a neighbour, or on an object too wide for the jaws.

    Args:
        height: Of a heightmap, metres above the floor.
        fingertip: Height above the floor, metres, to which the fingertips go for a pick at each pixel.
        angles: A; the jaws close along a share k / A of half a turn, counter-clockwise from the image's horizontal.
        inner: Metres from the pick to the inner side of each open finger.
        outer: Metres from the pick to the outer ends of the open fingers, along the jaws and across them.
        pixel: Metres a pixel.
    """
    smooth = ndimage.median_filter(height, size=3)  # a single reading is no object
    highest = np.stack(
        [ndimage.maximum_filter(smooth, footprint=_fingers(k * math.pi / angles, inner, outer, pixel)) for k in range(angles)]
    )
    return np.asarray(highest > fingertip + SLACK)


def _fingers(angle: float, inner: float, outer: tuple[float, float], pixel: float) -> Bool[np.ndarray, "N N"]:
    """The pixels below both fingers, around the pick in the middle."""
    radius = math.ceil(math.hypot(*outer) / pixel)
    rows, cols = np.mgrid[-radius : radius + 1, -radius : radius + 1] * pixel
    along = cols * math.cos(angle) - rows * math.sin(angle)  # rows go down
    across = cols * math.sin(angle) + rows * math.cos(angle)
    return np.asarray((np.abs(along) >= inner) & (np.abs(along) <= outer[0]) & (np.abs(across) <= outer[1]))
