"""From a depth image to an orthographic heightmap (paper, section III-A)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from see2act.robot.types import Heightmap, RobotError
from see2act.robot.workspace import Workspace

CRACK = 2.0
"""A pixel without a reading is a crack between samples if a reading is within this many pixels. It takes the nearest value."""
WALL = 0.002
"""Points nearer than this to the workspace's border belong to the bin's wall, moved inside by noise, metres."""
FLOOR = 0.01
"""Readings lower than this belong to the floor, metres."""


def point_cloud(
    depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"], pose: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "h w 3"]:
    """World point in metres of every image pixel.

    Args:
        depth: Metres along the optical axis.
        intrinsics: Pinhole matrix, pixels.
        pose: Camera to world; in the camera's frame x is right, y down and z forward.
    """
    h, w = depth.shape
    x = ((np.arange(w) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]).astype(np.float32)
    y = ((np.arange(h) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]).astype(np.float32)[:, None]
    points = np.empty((h, w, 3), np.float32)
    for axis, (right, down, forward, origin) in enumerate(pose[:3].astype(np.float32)):
        points[..., axis] = (x * right + (y * down + forward)) * depth + origin
    return points


def highest(
    points: Float[np.ndarray, "h w 3"], seen: np.ndarray, workspace: Workspace
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the highest point in each cell that has one.

    Returns:
        Rows and columns of the cells, and flat image indices of their highest points; each of length n (cells with a point).
    """
    flat = points.reshape(-1, 3)
    _, width = workspace.shape
    inside = (np.abs(flat[:, 0]) < workspace.width / 2 - WALL) & (np.abs(flat[:, 1]) < workspace.length / 2 - WALL)
    index = np.flatnonzero(seen.ravel() & inside)
    order = index[np.argsort(flat[index, 2], kind="stable")]
    rows, cols = workspace.to_pixel(flat[order, 0], flat[order, 1])
    cell = rows * width + cols
    winner = np.full(workspace.shape[0] * width, -1)
    winner[cell] = order  # the highest point is written last and stays
    cells = np.flatnonzero(winner >= 0)
    return cells // width, cells % width, winner[cells]


def project(color: np.ndarray, depth: np.ndarray, points: np.ndarray, workspace: Workspace) -> Heightmap:
    """The heightmap of one RGB-D image.

    Cells without a reading are filled: cracks with the nearest reading, and larger holes (space hidden from the camera) with
    the nearest reading of the floor. ``valid`` is False in both.

    Raises:
        RobotError: The depth has values that are not finite, or no point is in the workspace.
    """
    if not np.isfinite(depth).all():
        raise RobotError(f"the depth image holds {np.count_nonzero(~np.isfinite(depth))} values that are not finite")
    cells = highest(points, depth > 0, workspace)
    if not len(cells[0]):
        raise RobotError("no point of the depth image lies in the workspace: check the camera's pose and depth unit")
    return fill_in(color, points, cells, workspace.shape)


def fill_in(
    color: np.ndarray, points: np.ndarray, cells: tuple[np.ndarray, np.ndarray, np.ndarray], shape: tuple[int, int]
) -> Heightmap:
    """A heightmap of ``shape`` from the ``cells`` with a reading (rows, columns, image indices, as from :func:`highest`)."""
    rows, cols, index = cells
    valid = np.zeros(shape, bool)
    height = np.zeros(shape, np.float32)
    colors = np.zeros((*shape, 3), np.uint8)
    valid[rows, cols] = True
    height[rows, cols] = points.reshape(-1, 3)[index, 2]
    colors[rows, cols] = color.reshape(-1, 3)[index]
    source, known = fill(valid)
    floor = valid & (height < FLOOR)
    if floor.any():
        (floor_rows, floor_cols), _ = fill(floor)
        source = np.where(known, source[0], floor_rows), np.where(known, source[1], floor_cols)
    return Heightmap(colors[source], height[source], valid)


def fill(valid: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Find the cell from which each cell takes its value.

    Returns:
        Row and column of the nearest valid cell, and whether it is near enough that the cell is only a crack.
    """
    distance, (rows, cols) = ndimage.distance_transform_edt(~valid, return_indices=True)
    return (rows, cols), distance <= CRACK
