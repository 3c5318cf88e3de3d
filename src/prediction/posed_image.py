"""An RGB-D image of one's own, checked, in a frame whose origin is on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from see2act.errors import UserError
from see2act.robot.heightmap import point_cloud
from see2act.robot.workspace import Workspace
from see2act.seeding import generator

NEAREST, FARTHEST = 0.1, 5.0
"""Metres from the camera between which a bin is believed to be."""
SAMPLES = 500
"""Planes that are tried for the floor; with a floor of a quarter of the image one of them fits but for one time in 2 600."""
FLAT = 0.008
"""Metres from the plane within which a point is of the floor: some three times a stereo sensor's noise at a metre."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From centres at the index to centres at the index and a half, as cameras here have them."""
LEVEL, ASTRAY, HIGHEST = 0.004, 0.02, 0.3
"""Metres: a bin of the histogram that the floor is found in; how far from it a pose may put the floor; and how high above the
floor something between the bounds may reach."""
LYING = 0.15
"""Share of what is seen between the bounds that lies on the floor at least: a tenth to a third of a bin's is covered here."""
FEWEST = 100
"""Readings without which nothing can be said of a scene."""
LARGEST = 4e5
"""Pixels of the largest heightmap: 1.6 m by 1.6 m at 2.5 mm."""


class ImageError(UserError, ValueError):
    """An image, a calibration or bounds that nothing can be predicted from; the message is one line and says what to do."""


@dataclass(frozen=True)
class PosedImage:
    """An image in a frame that has its origin on the floor, in the middle of the bounds."""

    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    """Metres along the optical axis; 0 where there is no reading."""
    points: Float[np.ndarray, "h w 3"]
    """Metres in this frame, a point a pixel."""
    background: Float[np.ndarray, "h w"] | None
    """Depth of the empty bin."""
    background_points: Float[np.ndarray, "h w 3"]
    """Of the empty bin; the same as ``points`` without one."""
    workspace: Workspace
    origin: Float[np.ndarray, "3"]
    """Of the frame, in the world, metres."""
    pose: Float[np.ndarray, "4 4"]
    """Camera to world."""


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
        floor: The floor's z in the world, metres; None for 0 with a pose, and without one for where most lies.
        pixel: Metres a pixel of the heightmap.

    Raises:
        ImageError: Sizes, units, matrices or bounds make no sense, or no floor is seen.
    """
    depth = _metres(depth, color, "depth")
    background = None if background is None else _metres(background, color, "background depth")
    _check_matrices(intrinsics, pose, color.shape)
    _check_bounds(bounds, floor)
    centred, empty = intrinsics + HALF, depth if background is None else background
    to_world = floor_pose(empty, centred) if pose is None else np.asarray(pose, float)
    points = point_cloud(depth, centred, to_world)
    empty_points = points if background is None else point_cloud(background, centred, to_world)
    low_x, low_y, high_x, high_y = bounds or _floor_bounds(empty_points, empty, floor or 0)
    workspace = _workspace((high_x - low_x, high_y - low_y), pixel)
    inside = (empty_points[..., 0] > low_x) & (empty_points[..., 0] < high_x) & (empty > 0)
    inside &= (empty_points[..., 1] > low_y) & (empty_points[..., 1] < high_y)
    floor = _floor(empty_points[inside, 2], pose is not None, floor)
    origin = np.array([(low_x + high_x) / 2, (low_y + high_y) / 2, floor])
    moved = points - origin.astype(np.float32)
    moved_empty = moved if background is None else empty_points - origin.astype(np.float32)
    return PosedImage(color, depth, moved, background, moved_empty, workspace, origin, to_world)


def _floor(heights: Float[np.ndarray, " n"], known_pose: bool, given: float | None) -> float:
    """The floor's z, by the heights of what is seen between the bounds, and by what is said of it."""
    if not len(heights):
        raise ImageError("nothing of the image lies between the bounds: check depth-scale, bounds and pose")
    counts, edges = np.histogram(heights, bins=np.arange(heights.min(), heights.max() + 2 * LEVEL, LEVEL))
    middle = edges[counts.argmax()] + LEVEL / 2
    lying = heights[np.abs(heights - middle) < FLAT]
    level = float(lying.mean())
    if given is None and len(lying) < LYING * len(heights):
        raise ImageError(
            "no level floor is seen between the bounds: the pose must map camera to world, with z up (if it is world to "
            "camera, invert it); or give floor, its z"
        )
    floor = given if given is not None else 0.0 if known_pose else level
    if given is None and abs(level - floor) > ASTRAY:
        raise ImageError(
            f"most of what is seen between the bounds lies at z = {level:.3f} m, and the floor must be at 0: give "
            f"floor {level:.3f} if that is the floor, or check pose, depth-scale and bounds"
        )
    if np.mean(heights < floor - ASTRAY) > 0.5:
        raise ImageError(
            f"most of what is seen between the bounds lies below the floor, at z = {level:.3f} m: check floor {floor:.3f}, "
            "pose and bounds"
        )
    if np.mean(heights > floor + HIGHEST) > 0.01:
        raise ImageError(
            f"what is seen between the bounds reaches more than {HIGHEST} m above the floor: check depth-scale, and give the "
            "bounds of the inside of the bin"
        )
    return floor


def floor_pose(depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    """Camera to world, with the dominant plane of a depth image for the floor and its normal for up.

    RANSAC (Fischler and Bolles 1981) with planes through three readings, then least squares through all points of the best.

    Raises:
        ImageError: All readings lie on a line, or no plane faces the camera.
    """
    points = point_cloud(depth, intrinsics, np.eye(4))[depth > 0].astype(float)
    rng = generator("floor")
    some = points[rng.choice(len(points), min(len(points), 20_000), replace=False)]
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


def _metres(depth: np.ndarray, color: np.ndarray, name: str) -> Float[np.ndarray, "h w"]:
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
        raise ImageError(f"the colour image is {color.dtype} of shape {color.shape}: give 8-bit RGB, (rows, columns, 3)")
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


def _check_matrices(intrinsics: np.ndarray, pose: np.ndarray | None, shape: tuple[int, ...]) -> None:
    k = np.asarray(intrinsics, float)
    if (
        np.shape(k) != (3, 3)
        or not np.isfinite(k).all()
        or min(k[0, 0], k[1, 1]) <= 0
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
    pose = np.asarray(pose, float)
    rotation = pose[:3, :3] if np.shape(pose) == (4, 4) else np.zeros((3, 3))
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


def _check_bounds(bounds: tuple[float, float, float, float] | None, floor: float | None) -> None:
    if floor is not None and not math.isfinite(floor):
        raise ImageError(f"the floor {floor} is no number: give its z in metres")
    if bounds is not None and not np.isfinite(bounds).all():
        raise ImageError(f"the bounds {tuple(bounds)} are not all numbers: give smallest x, smallest y, largest x, largest y")


def _floor_bounds(points: np.ndarray, depth: np.ndarray, floor: float) -> tuple[float, float, float, float]:
    """Around the floor that is seen, but for its outermost hundredth to each side."""
    lying = points[(depth > 0) & (np.abs(points[..., 2] - floor) < FLAT)]
    if not len(lying):
        raise ImageError(f"no floor is in view at z = {floor:g} m: check pose and depth-scale, or give the floor's z")
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
