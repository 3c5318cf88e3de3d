"""The floor in a depth image: as the dominant plane, or as the lowest level plane between the bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from see2act.prediction.errors import ImageError
from see2act.robot.heightmap import point_cloud
from see2act.seeding import generator

SAMPLES = 500
"""Planes that are tried; with a floor of a quarter of what is seen, one of them fits but for one time in 2 600."""
POINTS = 20_000
"""Readings that they are tried on."""
FLAT = 0.008
"""Metres from the plane within which a point is of the floor: some three times a stereo sensor's noise at a metre."""
STEEPEST = math.radians(8)
"""Largest angle between the floor and the world's horizontal: more is no error of a calibration."""
BELOW, DEEP = 0.05, 0.02
"""Share of the readings that may lie so many metres below the floor: reflections and flying pixels do."""
FEWEST = 0.1
"""Share of what is seen between the bounds that lies on the floor at least: a tenth to a third of a bin's is covered here."""


@dataclass(frozen=True)
class Floor:
    """A plane of the world, z = level + slope . (x, y), metres."""

    level: float
    slope: tuple[float, float] = (0.0, 0.0)

    def at(self, x: np.ndarray | float, y: np.ndarray | float) -> Float[np.ndarray, "*n"]:
        """Its z there."""
        return np.asarray(self.level + self.slope[0] * x + self.slope[1] * y)

    @property
    def tilt(self) -> float:
        """Radians from the horizontal."""
        return math.atan(math.hypot(*self.slope))


def level_floor(points: Float[np.ndarray, "n 3"], near: float | None, within: float, below: float = BELOW) -> Floor | None:
    """The floor below what is seen, by RANSAC and least squares.

    Of the planes that are level within :data:`STEEPEST`, with little below them, it is the one with most readings.

    Args:
        points: Of the world, metres: what is seen between the bounds, of the empty bin if there is an image of it.
        near: The floor's z as it is said to be; None for anywhere.
        within: Metres from there at most, in the middle of the points.
        below: Share of the points that may lie below it.

    Returns:
        None where no such plane has :data:`FEWEST` of the readings.
    """
    rng = generator("floor")
    some = points[rng.choice(len(points), min(len(points), POINTS), replace=False)].astype(float)
    middle = some[:, :2].mean(axis=0)
    best, most = None, int(FEWEST * len(some))
    for corners in some[rng.integers(len(some), size=(SAMPLES, 3))]:
        plane = _through(corners)
        if plane is None or (near is not None and abs(plane.at(*middle) - near) > within):
            continue
        above = some[:, 2] - plane.at(some[:, 0], some[:, 1])
        support = int(np.count_nonzero(np.abs(above) < FLAT))
        if support > most and np.mean(above < -DEEP) <= below:
            best, most = plane, support
    if best is None:
        return None
    best = _refined(some, best)
    return best if near is None or abs(best.at(*middle) - near) <= within else None


def floor_pose(depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    """Camera to world, with the dominant plane of a depth image for the floor and its normal for up.

    RANSAC (Fischler and Bolles 1981) with planes through three readings, then least squares through all points of the best.

    Args:
        depth: Metres along the optical axis, 0 where there is no reading.
        intrinsics: Pinhole matrix, pixels, for pixels whose centres are at the index and a half.

    Raises:
        ImageError: All readings lie on a line, or no plane faces the camera.
    """
    points = point_cloud(depth, intrinsics, np.eye(4))[depth > 0].astype(float)
    rng = generator("floor")
    some = points[rng.choice(len(points), min(len(points), POINTS), replace=False)]
    corners = some[rng.integers(len(some), size=(SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, anchors = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], corners[lengths > 1e-9, 0]
    supports = [np.count_nonzero(np.abs((some - a) @ n) < FLAT) for n, a in zip(normals, anchors, strict=True)]
    if not supports:
        raise ImageError("all readings lie on a line, which has no floor: give pose")
    best = int(np.argmax(supports))
    normal, anchor = normals[best], anchors[best]
    for _ in range(3):
        near = points[np.abs((points - anchor) @ normal) < FLAT]
        anchor = near.mean(axis=0)
        normal = np.linalg.svd(near - anchor, full_matrices=False)[2][2]
    normal = normal if normal @ anchor < 0 else -normal  # towards the camera
    if -normal[2] < 0.1:
        raise ImageError("the dominant plane stands edge-on to the camera, so it is no floor: give pose")
    origin = np.array([0, 0, (anchor @ normal) / normal[2]])
    right = np.array([1.0, 0, 0]) - normal[0] * normal
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(normal, right), normal])  # rows: the world's axes in the camera's frame
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ origin
    return pose


def _through(corners: Float[np.ndarray, "3 3"]) -> Floor | None:
    """The plane through three points, unless it is steep."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    if abs(normal[2]) < math.cos(STEEPEST) * np.linalg.norm(normal) or not normal[2]:
        return None
    slope = float(-normal[0] / normal[2]), float(-normal[1] / normal[2])
    return Floor(float(corners[0, 2] - slope[0] * corners[0, 0] - slope[1] * corners[0, 1]), slope)


def _refined(points: Float[np.ndarray, "n 3"], floor: Floor) -> Floor:
    """Least squares through its points, three times."""
    for _ in range(3):
        lying = points[np.abs(points[:, 2] - floor.at(points[:, 0], points[:, 1])) < FLAT]
        known = np.column_stack([np.ones(len(lying)), lying[:, :2]])
        level, *slope = np.linalg.lstsq(known, lying[:, 2], rcond=None)[0]
        floor = Floor(float(level), (float(slope[0]), float(slope[1])))
    return floor
