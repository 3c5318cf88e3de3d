"""From the raw images of a depth camera to a :class:`~see2act.robot.real.camera.Frame`: medians, lenses, two cameras in one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Float, UInt8

Count = Annotated[int, Ge(1)]
Seconds = Annotated[float, Gt(0)]
FOOTPRINT = 1.1
"""Width of a depth pixel over the distance to the next one. Above 1, so that a surface has no cracks where the other camera
sees it wider: with cameras 15 mm apart (D415) at 0.7 m, surfaces of up to 78 degrees."""


def median_color(images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Median of each pixel and channel."""
    return _sorted(images)[(len(images) - 1) // 2]


def median_depth(images: Sequence[np.ndarray]) -> np.ndarray:
    """Median of the readings of each pixel; 0 where less than half of the images have one.

    Of an even number of readings it is the lower one in the middle, not the mean of two: at an edge, that could be a point in
    mid-air.

    Args:
        images: Of shape (h, w), any unit and type of number; 0 where there is no reading.
    """
    ordered = np.stack(_sorted(images))
    readings = np.count_nonzero(ordered, axis=0)
    middle = len(images) - readings + np.maximum(readings - 1, 0) // 2  # those without a reading come first
    median = np.take_along_axis(ordered, np.minimum(middle, len(images) - 1)[None], 0)[0]
    return np.where(2 * readings >= len(images), median, 0).astype(ordered.dtype)


def rectify(image: np.ndarray, source: Float[np.ndarray, "h w 2"], smooth: bool) -> np.ndarray:
    """Take each pixel from another place of the image; 0 where that lies outside.

    Args:
        source: Column and row in ``image`` of each pixel of the result, float32.
        smooth: Whether to interpolate, as is right for colour. Otherwise the nearest pixel is taken, as is right for depth.
    """
    return cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)


class Registration:
    """Gives the depth that a depth camera measures to the pixels of a colour camera beside it.

    In place of librealsense's ``rs.align``, which (2.59, x86) keeps the distance from the depth camera, though the two cameras
    do not look in quite the same direction (0.2 degrees are 1 mm of depth at 0.3 m beside the axis), and which leaves out the
    lens of the colour cameras of the D400 series.

    Args:
        rays: Point at depth 1 of each pixel of the depth camera, in its frame.
        pose: The depth camera in the frame of the colour camera, metres.
        intrinsics: Pinhole matrix of the colour camera, pixels; the centre of a pixel is at its index.
        shape: Rows and columns of the colour image.
    """

    def __init__(
        self,
        rays: Float[np.ndarray, "h w 3"],
        pose: Float[np.ndarray, "4 4"],
        intrinsics: Float[np.ndarray, "3 3"],
        shape: tuple[int, int],
    ):
        self._rays = (rays @ (intrinsics @ pose[:3, :3]).T).astype(np.float32)
        self._origin = (intrinsics @ pose[:3, 3]).astype(np.float32)
        self._shape = shape
        steps = np.median(np.diff(rays[..., 0], axis=1)), np.median(np.diff(rays[..., 1], axis=0))
        self._half = FOOTPRINT / 2 * np.array([intrinsics[0, 0] * steps[0], intrinsics[1, 1] * steps[1]], np.float32)

    def __call__(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "H W"]:
        """Metres along the optical axis of the colour camera, float32; 0 where the depth camera saw nothing.

        Args:
            depth: Metres along the optical axis of the depth camera, float32; 0 where there is no reading.
        """
        seen = depth > 0
        distance = depth[seen][:, None]
        points = self._rays[seen] * distance + self._origin
        z = points[:, 2]
        place, half = points[:, :2] / points[:, 2:], self._half * distance / points[:, 2:]
        first = np.ceil(place - half).astype(np.int32)
        last = np.floor(place + half).astype(np.int32)
        nearest = np.full(self._shape, np.inf, np.float32)
        most = (last - first).max(axis=0, initial=0) + 1
        for right, down in np.ndindex(*most):
            col, row = (first + [right, down]).T
            inside = (col <= last[:, 0]) & (row <= last[:, 1]) & (col >= 0) & (row >= 0)
            inside &= (col < self._shape[1]) & (row < self._shape[0])
            np.minimum.at(nearest.ravel(), row[inside] * self._shape[1] + col[inside], z[inside])
        return np.where(np.isinf(nearest), np.float32(0), nearest)


def _sorted(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Each pixel's values in ascending order. Exchanges whole images, some times faster than ``np.sort`` over so few values."""
    result = list(images)
    for turn in range(len(result)):
        for i in range(turn % 2, len(result) - 1, 2):
            result[i], result[i + 1] = np.minimum(result[i], result[i + 1]), np.maximum(result[i], result[i + 1])
    return result
