"""The best picks in an RGB-D image of one's own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.special import expit
from see2act.robot.heightmap import highest, point_cloud, project
from see2act.robot.types import Heightmap
from see2act.robot.workspace import Workspace
from see2act.seeding import generator
from see2act.trained import TrainedModel, load

NEAREST, FARTHEST = 0.1, 5.0
"""Metres from the camera between which a bin is believed to be."""
SAMPLES = 500
"""Planes that are tried for the floor; with a floor of a quarter of the image one of them fits but for one time in 2 600."""
FLAT = 0.008
"""Metres from the plane within which a point is of the floor: some three times a stereo sensor's noise at a metre."""
STATIC = 0.005
"""Metres above the background that are not an object yet."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From centres at the index to centres at the index and a half, as cameras here have them."""
LARGEST = 4e5
"""Pixels of the largest heightmap: 1.6 m by 1.6 m at 2.5 mm."""


class ImageError(ValueError):
    """An image, a calibration or bounds that nothing can be predicted from; the message is one line and names the mend."""


@dataclass(frozen=True)
class ScoredPick:
    """One proposed pick."""

    score: float
    """Predicted probability of success."""
    row: int
    col: int
    """Pixel of the heightmap."""
    u: int
    v: int
    """Column and row of the pixel in the image."""
    position: tuple[float, float, float]
    """Metres in the world: z up from the floor."""
    position_camera: tuple[float, float, float]
    """Metres in the camera's frame: x right, y down, z forward."""
    angle: float | None
    """Radians, counter-clockwise seen from above, from the world's x: along this the jaws close. None for suction."""


@dataclass(frozen=True)
class Prediction:
    """What a model makes of an image."""

    picks: tuple[ScoredPick, ...]
    """Best first."""
    heightmap: Heightmap
    scores: Float[np.ndarray, "H W"]
    """The best over all angles at each pixel of the heightmap; 0 where nothing may be picked."""
    source: Int[np.ndarray, "H W"]
    """Flat index of the image pixel that each pixel of the heightmap was seen in, -1 where there is none."""
    pose: Float[np.ndarray, "4 4"]
    """Camera to world."""
    intrinsics: Float[np.ndarray, "3 3"]
    workspace: Workspace
    """The heightmap's grid. Its origin is the world's, moved to the middle of the bounds."""
    primitive: str


def predict(
    color: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, "3 3"],
    checkpoint: str | Path | TrainedModel,
    *,
    pose: Float[np.ndarray, "4 4"] | None = None,
    background_depth: Float[np.ndarray, "h w"] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    count: int = 10,
    apart: float = 0.02,
) -> Prediction:
    """The best picks in an RGB-D image.

    The image is projected to a heightmap, seen along gravity, at the resolution that the model learned from; the model
    scores every pixel of it, and of the best ones those are given that lie apart from each other.

    Args:
        color: RGB.
        depth: Metres along the optical axis; 0 or NaN where there is no reading.
        intrinsics: Pinhole matrix in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; a pixel's centre is at its index, as in
            OpenCV and RealSense.
        checkpoint: A run's ``checkpoints/model.safetensors``, one of ``models/``, or what :func:`see2act.trained.load` gave.
        pose: Camera to world: x right, y down, z forward in the image; in the world z points up, and the floor is at 0.
            Without one the floor is the dominant plane, of the background if there is one; then the world's x is the
            image's to the right, and its origin lies where the optical axis meets the floor.
        background_depth: The same view of the empty bin, in metres. What is less than 5 mm above it is not picked.
        bounds: Smallest x, smallest y, largest x and largest y of the world, in metres, between which to pick; without them,
            wherever floor is seen.
        count: Picks at most.
        apart: Metres between any two of them.

    Returns:
        The picks, best first, and all that a picture of them needs. ``picks`` is empty where nothing may be picked.

    Raises:
        ImageError: Sizes differ, the depth is not in metres, a matrix is none, or nothing is in view.
        see2act.trained.ModelFileError: The checkpoint is none.

    Example:
        >>> best = see2act.predict(color, depth, intrinsics, "models/suction.safetensors").picks[0]  # doctest: +SKIP
        >>> best.position_camera, best.score  # doctest: +SKIP
    """
    model = checkpoint if isinstance(checkpoint, TrainedModel) else load(Path(checkpoint))
    depth = _metres(depth, color, "depth")
    background = None if background_depth is None else _metres(background_depth, color, "background depth")
    _check_matrices(intrinsics, pose)
    centred = intrinsics + HALF
    empty = depth if background is None else background
    pose = floor_pose(empty, centred) if pose is None else np.asarray(pose, float)
    points = point_cloud(depth, centred, pose)
    empty_points = points if background is None else point_cloud(background, centred, pose)
    low_x, low_y, high_x, high_y = bounds or _floor_bounds(empty_points, empty)
    workspace = _workspace((high_x - low_x, high_y - low_y), model.pixel)
    middle = np.array([(low_x + high_x) / 2, (low_y + high_y) / 2, 0], np.float32)
    points = points - middle
    rows, cols, index = highest(points, depth > 0, workspace)
    if not len(index):
        raise ImageError("nothing of the image lies within the bounds: check bounds and pose, in metres")
    heightmap = project(color, depth, points, workspace)
    source = np.full(workspace.shape, -1)
    source[rows, cols] = index
    allowed = source >= 0
    if background is not None:
        under = project(color, background, empty_points - middle, workspace)
        allowed &= heightmap.height - under.height > STATIC
    logits = np.where(allowed, model.affordances(heightmap.color, heightmap.height), -np.inf)
    camera = point_cloud(depth, centred, np.eye(4)).reshape(-1, 3)
    picks = []
    for angle, row, col in _best(logits, count, apart / model.pixel):
        seen = int(source[row, col])
        v, u = divmod(seen, depth.shape[1])
        radians = angle * math.pi / len(logits) if len(logits) > 1 else None
        x, y, z = (float(n) for n in points.reshape(-1, 3)[seen] + middle)
        near = (float(camera[seen, 0]), float(camera[seen, 1]), float(camera[seen, 2]))
        picks.append(ScoredPick(float(expit(logits[angle, row, col])), row, col, u, v, (x, y, z), near, radians))
    scores = expit(logits.max(axis=0))
    return Prediction(tuple(picks), heightmap, scores, source, pose, intrinsics, workspace, model.primitive)


def floor_pose(depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    """Camera to world, with the dominant plane of a depth image for the floor and its normal for up.

    RANSAC (Fischler and Bolles 1981) with planes through three readings, then least squares through all points of the best.

    Raises:
        ImageError: There are too few readings, or no plane faces the camera.
    """
    points = point_cloud(depth, intrinsics, np.eye(4))[depth > 0].astype(float)
    if len(points) < 100:
        raise ImageError(f"the depth image has {len(points)} readings, too few to find the floor: give pose")
    rng = generator("floor")
    some = points[rng.choice(len(points), min(len(points), 20_000), replace=False)]
    corners = some[rng.integers(len(some), size=(SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, anchors = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], corners[lengths > 1e-9, 0]
    supports = [np.count_nonzero(np.abs((some - a) @ n) < FLAT) for n, a in zip(normals, anchors, strict=True)]
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
    if not len(readings):
        raise ImageError(f"the {name} image has no reading")
    median = float(np.median(readings))
    if not NEAREST <= median <= FARTHEST:
        raise ImageError(
            f"half of the {name} lies beyond {median:.3g} m: it must be in metres; check depth-scale, the units per metre "
            "(1000 for millimetres, 10000 for tenths of them)"
        )
    return metres


def _check_matrices(intrinsics: np.ndarray, pose: np.ndarray | None) -> None:
    if np.shape(intrinsics) != (3, 3) or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise ImageError("the intrinsics must be a 3 x 3 pinhole matrix in pixels: fx 0 cx, 0 fy cy, 0 0 1")
    if pose is None:
        return
    if np.shape(pose) != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
        raise ImageError(
            "the pose must be a 4 x 4 matrix, camera to world, with a rotation in its first three rows and columns"
        )


def _floor_bounds(points: np.ndarray, depth: np.ndarray) -> tuple[float, float, float, float]:
    """Around the floor that is seen, but for its outermost hundredth to each side."""
    floor = points[(depth > 0) & (np.abs(points[..., 2]) < FLAT)]
    if not len(floor):
        raise ImageError("no floor is in view at the pose's z = 0: check the pose, or give bounds")
    (low_x, low_y), (high_x, high_y) = np.percentile(floor[:, :2], [1, 99], axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)


def _workspace(size: tuple[float, float], pixel: float) -> Workspace:
    if min(size) < 4 * pixel:
        raise ImageError(f"the bounds span {size[0]:.3g} x {size[1]:.3g} m: give smallest x, smallest y, largest x, largest y")
    if size[0] * size[1] / pixel**2 > LARGEST:
        raise ImageError(
            f"the bounds span {size[0]:.3g} x {size[1]:.3g} m, too much for {pixel * 1000:.3g} mm a pixel: give bounds"
        )
    width, length = (math.ceil(side / pixel) * pixel for side in size)
    return Workspace("image", width, length, pixel)


def _best(logits: Float[np.ndarray, "A H W"], count: int, apart: float) -> list[tuple[int, int, int]]:
    """Angle, row and column of the highest logits, none within ``apart`` pixels of a better one."""
    best = logits.max(axis=0)
    v, u = np.ogrid[: best.shape[0], : best.shape[1]]
    chosen: list[tuple[int, int, int]] = []
    while len(chosen) < count and np.isfinite(best.max()):
        row, col = (int(i) for i in np.unravel_index(best.argmax(), best.shape))
        chosen.append((int(logits[:, row, col].argmax()), row, col))
        best[(v - row) ** 2 + (u - col) ** 2 < apart**2] = -np.inf
    return chosen
