"""An RGB-D image of one's own, checked, in a frame whose origin is on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from see2act.prediction.depth import with_small_holes_filled, without_flying_pixels
from see2act.prediction.errors import ImageError
from see2act.prediction.floor import BELOW, DEEP, FLAT, Floor, floor_pose, level_floor
from see2act.robot.heightmap import point_cloud
from see2act.robot.workspace import Workspace

NEAREST, FARTHEST = 0.1, 5.0
"""Metres from the camera between which a bin is believed to be."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From centres at the index to centres at the index and a half, as cameras here have them."""
HIGHEST = 0.3
"""Metres above the floor that something between the bounds may reach."""
MOST = 0.06
"""Metres by which the floor may lie elsewhere than it is said to: more is no error of a calibration."""
NOTED, TILTED = 0.01, 2.0
"""Metres, and degrees, from which such an error is worth a warning."""
FEWEST = 100
"""Readings without which nothing can be said of a scene."""
LARGEST = 4e5
"""Pixels of the largest heightmap: 1.6 m by 1.6 m at 2.5 mm."""


LONGEST = 100
"""Focal length at most, in sides of the image: a telescope's."""


@dataclass(frozen=True)
class PosedImage:
    """An image in a frame that has its origin on the floor, in the middle of the bounds."""

    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    """Metres along the optical axis; 0 where there is no reading. Without flying pixels, and with small holes filled."""
    read: Bool[np.ndarray, "h w"]
    """Where the depth is a reading, and no hole that was filled."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Pinhole matrix, pixels, for pixels whose centres are at the index and a half."""
    points: Float[np.ndarray, "h w 3"]
    """Metres in this frame, a point a pixel."""
    background: Float[np.ndarray, "h w"] | None
    """Depth of the empty bin."""
    background_points: Float[np.ndarray, "h w 3"]
    """Of the empty bin; the same as ``points`` without one."""
    workspace: Workspace
    middle: tuple[float, float]
    """Of the bounds: x and y of the frame's origin in the world, metres."""
    floor: Floor
    """Of the world. The frame's heights are above it."""
    pose: Float[np.ndarray, "4 4"]
    """Camera to world."""
    notes: tuple[str, ...]
    """What is to be said of the floor, a line each."""

    def world(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point of this frame in the world, metres."""
        x, y = point[0] + self.middle[0], point[1] + self.middle[1]
        return np.array([x, y, point[2] + self.floor.at(x, y)])

    def in_view(self, height: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """Which pixels of a heightmap of metres above the floor lie within the image."""
        rows, cols = np.indices(height.shape, float)
        x, y = (part + offset for part, offset in zip(self.workspace.to_world(rows, cols), self.middle, strict=True))
        world = np.stack([x, y, height + self.floor.at(x, y), np.ones(height.shape)])
        u, v, w = np.tensordot(self.intrinsics @ np.linalg.inv(self.pose)[:3], world, 1)
        tall, wide = self.depth.shape
        return np.asarray((w > 0) & (u > 0) & (u < wide * w) & (v > 0) & (v < tall * w))


def look(
    color: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    background: Float[np.ndarray, "h w"] | None,
    intrinsics: Float[np.ndarray, "3 3"],
    pose: Float[np.ndarray, "4 4"] | None,
    bounds: tuple[float, float, float, float] | None,
    floor: float | None,
    pixel: float,
) -> PosedImage:
    """Check everything, and find the floor.

    Args:
        color: RGB.
        depth: Metres along the optical axis; 0 or not finite where there is no reading.
        background: The same of the empty bin, by which the floor is found better.
        intrinsics: Pinhole matrix in pixels, for pixels whose centres are at whole numbers.
        pose: Camera to world, metres, z up; None finds the floor, which is the world's z = 0 then.
        bounds: Smallest x, smallest y, largest x, largest y of the inside of the bin in the world, metres; None takes the
            floor that is seen.
        floor: The floor's z in the world, metres; None for 0 with a pose, and without one for where it is seen. The floor that
            is seen near it counts.
        pixel: Metres a pixel of the heightmap.

    Raises:
        ImageError: Sizes, units, matrices or bounds make no sense, or no floor is seen.
    """
    if bounds is not None:
        bounds = _four(bounds)
        _check_bounds(bounds, pixel)
    if floor is not None and not np.isfinite(_numbers(floor, (), "floor", "its z in metres")):
        raise ImageError(f"the floor {floor} is no number: give its z in metres")
    depth = _metres(depth, color, "depth")
    background = None if background is None else _metres(background, color, "background depth")
    intrinsics = _numbers(intrinsics, (3, 3), "intrinsics", "a 3 x 3 pinhole matrix in pixels")
    pose = None if pose is None else _numbers(pose, (4, 4), "pose", "a 4 x 4 matrix, camera to world")
    _check_matrices(intrinsics, pose, color.shape)
    depth = without_flying_pixels(depth, intrinsics)
    read, depth = depth > 0, with_small_holes_filled(depth, intrinsics)
    if background is not None:
        background = with_small_holes_filled(without_flying_pixels(background, intrinsics), intrinsics)
    centred, empty = intrinsics + HALF, depth if background is None else background
    to_world = floor_pose(empty, centred) if pose is None else np.asarray(pose, float)
    points = point_cloud(depth, centred, to_world)
    empty_points = points if background is None else point_cloud(background, centred, to_world)
    seen = empty_points[(empty > 0) & (_inside(empty_points, bounds) if bounds else True)]
    plane, notes = _floor(seen, pose is not None, floor, bounds is not None)
    low_x, low_y, high_x, high_y = bounds = bounds or _floor_bounds(empty_points, empty, plane)
    workspace = _workspace((high_x - low_x, high_y - low_y), pixel)
    middle = (low_x + high_x) / 2, (low_y + high_y) / 2
    moved = _above(plane, points, middle)
    moved_empty = moved if background is None else _above(plane, empty_points, middle)
    _refuse_towers(moved_empty[(empty > 0) & _inside(empty_points, bounds), 2])
    return PosedImage(
        color, depth, read, centred, moved, background, moved_empty, workspace, middle, plane, to_world, tuple(notes)
    )


def _inside(points: Float[np.ndarray, "h w 3"], bounds: tuple[float, float, float, float]) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    return np.asarray((x > bounds[0]) & (x < bounds[2]) & (y > bounds[1]) & (y < bounds[3]))


def _above(floor: Floor, points: Float[np.ndarray, "h w 3"], middle: tuple[float, float]) -> Float[np.ndarray, "h w 3"]:
    """The same points from the middle of the bounds, with heights above the floor for z."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([x - middle[0], y - middle[1], z - floor.at(x, y)], axis=-1).astype(np.float32)


def _refuse_towers(heights: Float[np.ndarray, " n"]) -> None:
    if np.mean(heights > HIGHEST) > 0.01:
        raise ImageError(
            f"what is seen between the bounds reaches more than {HIGHEST} m above the floor: check depth-scale, and give the "
            "bounds of the inside of the bin"
        )


def _floor(points: Float[np.ndarray, "n 3"], known_pose: bool, given: float | None, bounded: bool) -> tuple[Floor, list[str]]:
    """The floor that is seen, and what is to be said of it."""
    if not len(points):
        raise ImageError("nothing of the image lies between the bounds: check depth-scale, bounds and pose")
    said = given if given is not None else 0.0 if known_pose else None
    below = BELOW if bounded else 1.0  # around a bin there may be anything
    floor = level_floor(points, said, MOST, below)
    middle = points[:, :2].mean(axis=0)
    if floor is None and said is not None:
        elsewhere = level_floor(points, None, MOST, below)
        if elsewhere is not None:
            z = float(elsewhere.at(*middle))
            raise ImageError(
                f"the floor is seen at z = {z:.3f} m, and not within {100 * MOST:g} cm of {said:g}: give floor {z:.3f} if that "
                "is the floor, or check pose, depth-scale and bounds"
            )
    if floor is None and given is None:
        raise ImageError(
            "no level floor is seen: the pose must map camera to world, with z up (if it is world to camera, invert it); or "
            "give floor, its z"
        )
    if floor is None:
        assert given is not None
        if np.mean(points[:, 2] < given - DEEP) > 0.5:
            raise ImageError(f"most of what is seen lies below the floor: check floor {given:g}, pose and bounds")
        return Floor(given), [f"warning: so little of the floor is seen that {given:g} m could not be checked"]
    if said is None:
        return floor, []
    off, tilt = float(floor.at(*middle)) - said, math.degrees(floor.tilt)
    text = f"the floor is seen {1000 * off:+.0f} mm from z = {said:g} m, tilted by {tilt:.1f} degrees; heights are from there"
    return floor, [f"warning: {text}; check the pose" if abs(off) > NOTED or tilt > TILTED else text]


def _metres(depth: np.ndarray, color: np.ndarray, name: str) -> Float[np.ndarray, "h w"]:
    if not isinstance(color, np.ndarray) or color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
        raise ImageError(f"the colour image is {_described(color)}: give 8-bit RGB, (rows, columns, 3)")
    if not isinstance(depth, np.ndarray) or depth.ndim < 2 or depth.dtype.kind not in "iuf":
        raise ImageError(f"the {name} image is {_described(depth)}: give metres, (rows, columns)")
    if depth.shape != color.shape[:2]:
        sizes = " and ".join(f"{n[1]} x {n[0]}" for n in (color.shape, depth.shape[:2]))
        raise ImageError(f"colour and {name} have different sizes, {sizes}: register the depth to the colour camera")
    metres = np.nan_to_num(np.asarray(depth, np.float32), nan=0, posinf=0, neginf=0)
    readings = metres[metres > 0]
    if len(readings) < FEWEST:
        raise ImageError(f"the {name} image has {len(readings) or 'no'} readings: it needs {FEWEST} at least")
    median = float(np.median(readings))
    if not NEAREST <= median <= FARTHEST:
        raise ImageError(
            f"the median {name} is {median:.3g} m, and must lie between {NEAREST} and {FARTHEST} m: check depth-scale, the "
            "units per metre (1000 for millimetres, 10000 for tenths of them)"
        )
    return metres


def _described(image: object) -> str:
    return f"{image.dtype} of shape {image.shape}" if isinstance(image, np.ndarray) else f"a {type(image).__name__}"


def _numbers(given: object, shape: tuple[int, ...], name: str, what: str) -> Float[np.ndarray, "..."]:
    """What was given, as numbers.

    Raises:
        ImageError: It is of another shape, or no real numbers.
    """
    try:
        array = np.asarray(given)
    except ValueError:  # rows of different lengths
        array = np.empty(0)
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise ImageError(f"the {name} is of shape {array.shape} and type {array.dtype}: give {what}")
    return array.astype(float)


def _four(bounds: object) -> tuple[float, float, float, float]:
    low_x, low_y, high_x, high_y = _numbers(bounds, (4,), "bounds", "smallest x, smallest y, largest x, largest y").tolist()
    return low_x, low_y, high_x, high_y


def _check_matrices(intrinsics: np.ndarray, pose: np.ndarray | None, shape: tuple[int, ...]) -> None:
    k = intrinsics
    if (
        not np.isfinite(k).all()
        or not (0 < min(k[0, 0], k[1, 1]) <= max(k[0, 0], k[1, 1]) < LONGEST * max(shape))
        or not (k[2] == (0, 0, 1)).all()
        or k[0, 1]
        or k[1, 0]
    ):
        raise ImageError("the intrinsics must be a 3 x 3 pinhole matrix in pixels: fx 0 cx, 0 fy cy, 0 0 1")
    if not (0 < k[0, 2] < shape[1] and 0 < k[1, 2] < shape[0]):
        raise ImageError(
            f"the intrinsics have their principal point at ({k[0, 2]:g}, {k[1, 2]:g}), outside the image of {shape[1]} x "
            f"{shape[0]}: give those of this resolution, in pixels"
        )
    if pose is None:
        return
    rotation = pose[:3, :3]
    if not np.isfinite(pose).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise ImageError(
            "the pose must be a 4 x 4 matrix, camera to world, with a rotation in its first three rows and columns"
        )
    if np.linalg.det(rotation) < 0 or not np.allclose(pose[3], (0, 0, 0, 1)):
        raise ImageError("the pose must end in 0 0 0 1 and must not mirror: x right, y down, z forward in the image")
    if pose[2, 2] >= 0 or pose[2, 3] <= -FARTHEST:
        raise ImageError(
            "by this pose the camera looks up: it must map camera to world, with z up; if it is world to camera, invert it"
        )


def _check_bounds(bounds: tuple[float, float, float, float], pixel: float) -> None:
    if not np.isfinite(bounds).all():
        raise ImageError(f"the bounds {tuple(bounds)} are not all numbers: give smallest x, smallest y, largest x, largest y")
    _workspace((bounds[2] - bounds[0], bounds[3] - bounds[1]), pixel)


def _floor_bounds(points: np.ndarray, depth: np.ndarray, floor: Floor) -> tuple[float, float, float, float]:
    """Around the floor that is seen, but for its outermost hundredth to each side."""
    lying = points[(depth > 0) & (np.abs(points[..., 2] - floor.at(points[..., 0], points[..., 1])) < FLAT)]
    if not len(lying):
        raise ImageError(f"no floor is in view at z = {floor.level:g} m: check pose and depth-scale, or give the floor's z")
    (low_x, low_y), (high_x, high_y) = np.percentile(lying[:, :2], [1, 99], axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)


def _workspace(size: tuple[float, float], pixel: float) -> Workspace:
    if min(size) < 4 * pixel:
        raise ImageError(f"the bounds span {size[0]:.3g} x {size[1]:.3g} m: give smallest x, smallest y, largest x, largest y")
    if size[0] * size[1] / pixel**2 > LARGEST:
        raise ImageError(
            f"the bounds span {size[0]:.3g} x {size[1]:.3g} m, too much for {pixel * 1000:.3g} mm a pixel: check depth-scale, "
            "and give the bounds of the inside of the bin"
        )
    width, length = (math.ceil(side / pixel - 1e-6) * pixel for side in size)  # 0.4 - 0.1 is more than 0.3
    return Workspace("image", width, length, pixel)
