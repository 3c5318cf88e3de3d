"""What is wrong with real depth images and can be mended: readings in the air at edges, and small holes."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

GRAZING = math.radians(10)
"""Angle to the line of sight below which sensors hardly read a surface: what looks steeper is none."""
SPECKLE = 0.005
"""Metres: a patch of fewer pixels than a square of this side has is no object."""
PATCH = 0.03
"""Metres across of the largest hole that is filled: a larger one may hide an object."""
LEVEL = 0.005
"""Metres from a plane to the readings around a hole at most: around what is hidden by an object they are farther from any."""
UNITS, MISSING = 8000, -32768
"""Of the natural logarithm of metres, for 16 bits; and no reading."""


def without_flying_pixels(depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "h w"]:
    """The depth image without the readings that hang in the air, which become 0.

    At an edge sensors mix the depths of both sides. Such a reading is much farther than its neighbour on one side, and much
    nearer than that on the other; a missing neighbour counts as either. Wires, which are nearer than both, stay. Patches
    smaller than any object, away from everything around them, go too.

    Args:
        depth: Metres along the optical axis; 0 where there is no reading.
        intrinsics: Pinhole matrix, pixels.
    """
    flying = np.zeros(depth.shape, bool)
    for axis, focal in ((0, intrinsics[1, 1]), (1, intrinsics[0, 0])):
        steepest = depth * _steepest(focal)
        before, after = (_shifted(depth, axis, by) for by in (1, -1))
        for sign in (1, -1):
            steps = [sign * (depth - before) > steepest, sign * (after - depth) > steepest]
            flying |= (steps[0] | (before == 0)) & (steps[1] | (after == 0)) & (before + after > 0)
    return _without_speckles(np.where(flying, 0, depth), intrinsics[0, 0])


def _without_speckles(depth: np.ndarray, focal: float) -> Float[np.ndarray, "h w"]:
    """OpenCV's filter, on logarithms: in them a steepest step is the same at every depth."""
    read = depth > 0
    logarithms = np.full(depth.shape, MISSING, np.int16)
    logarithms[read] = np.clip(np.log(depth[read]) * UNITS, MISSING + 1, None)
    smallest = (SPECKLE * focal / np.median(depth[read])) ** 2 if read.any() else 0
    kept = cv2.filterSpeckles(logarithms, MISSING, round(smallest), _steepest(focal) * UNITS)[0]
    return np.where(kept == MISSING, 0, depth).astype(np.float32)


def _steepest(focal: float) -> float:
    """Share of its depth by which a surface at the grazing angle comes nearer from one pixel to the next."""
    return 1 / (focal * math.tan(GRAZING))


def with_small_holes_filled(depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "h w"]:
    """The depth image with holes within one surface, as dark and shiny things have them, filled.

    Args:
        depth: Metres along the optical axis; 0 where there is no reading.
        intrinsics: Pinhole matrix, pixels.
    """
    mended = depth.astype(np.float32)
    holes, _ = ndimage.label(depth == 0, np.ones((3, 3)))
    for number, (rows, cols) in enumerate(ndimage.find_objects(holes), start=1):
        if min(rows.start, cols.start) == 0 or rows.stop == len(depth) or cols.stop == len(depth[0]):
            continue
        around = slice(rows.start - 1, rows.stop + 1), slice(cols.start - 1, cols.stop + 1)
        hole, part = holes[around] == number, mended[around]
        rim = ndimage.binary_dilation(hole, np.ones((3, 3))) & ~hole
        if max(hole.shape) - 2 > PATCH * intrinsics[0, 0] / part[rim].max():
            continue
        surface = _plane(part, rim)
        if np.abs(surface - part)[rim].max() <= LEVEL:
            part[hole] = surface[hole]
    return mended


def _plane(depth: np.ndarray, readings: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth of the plane through some readings: its inverse is linear in row and column."""
    known = np.column_stack([*np.nonzero(readings), np.ones(np.count_nonzero(readings))])
    rows, cols, constant = np.linalg.lstsq(known, 1 / depth[readings], rcond=None)[0]
    v, u = np.indices(depth.shape)
    return np.asarray(1 / np.maximum(rows * v + cols * u + constant, 1e-6))


def _shifted(depth: np.ndarray, axis: int, by: int) -> Float[np.ndarray, "h w"]:
    """Each pixel's neighbour along an axis; 0 beyond the border."""
    moved = np.roll(depth, by, axis)
    moved[(slice(None),) * axis + (0 if by > 0 else -1,)] = 0
    return moved
