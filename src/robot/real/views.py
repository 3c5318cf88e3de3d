"""What a calibration is made from: the poses to which the arm carries the board, and what the camera sees there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from see2act.robot.real.board import Board, detect
from see2act.seeding import generator


@dataclass(frozen=True)
class View:
    """The board at one pose of the flange."""

    flange: Float[np.ndarray, "4 4"]
    """Flange to base, metres, as the controller reports it."""
    ids: Int[np.ndarray, " k"]
    """Rows of :meth:`Board.corners`."""
    pixels: Float[np.ndarray, "k 2"]
    """Column and row of these corners; the centre of a pixel is at its index."""
    depth: Float[np.ndarray, " k"]
    """At these corners, metres along the optical axis, as the camera gives it; 0 where there is none."""


def seen(
    flange: Float[np.ndarray, "4 4"], color: UInt8[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"], board: Board
) -> View | None:
    """The view of one image; None where too little of the board is seen.

    Args:
        flange: Flange to base, metres.
        color: RGB, or grey without the last axis.
        depth: Metres along the optical axis, of the same pixels; 0 where there is none.
        board: What the flange carries.

    Raises:
        RobotError: The image shows the board mirrored.
    """
    found = detect(color, board)
    if found is None:
        return None
    return View(flange, found.ids, found.pixels, np.array([_reading(depth, *pixel) for pixel in found.pixels]))


def bin_points(world: Float[np.ndarray, "4 4"], size: tuple[float, float], height: float = 0.04) -> Float[np.ndarray, "n 3"]:
    """Where accuracy matters: a grid on the bin's floor, and as many points above it.

    Args:
        world: World to base, metres; the world's origin is in the middle of the bin's floor.
        size: Extent of the floor along the world's x and y, metres.
        height: Of the points above the floor, metres.
    """
    x, y, z = np.meshgrid(*(np.linspace(-side / 2, side / 2, 7) for side in size), (0, height), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]) @ world[:3, :3].T + world[:3, 3]


def propose(
    start: Float[np.ndarray, "4 4"],
    centre: Float[np.ndarray, "3"],
    count: int = 25,
    radius: float = 0.12,
    tilt: float = 0.7,
    seed: int = 0,
) -> list[Float[np.ndarray, "4 4"]]:
    """Poses of the flange from which to calibrate, flange to base; the same for the same seed.

    Nothing here knows what the arm can reach or would touch.

    Args:
        start: A pose from which the camera sees the board in the middle of its image, facing it.
        centre: Of the board, in the flange's frame, metres; a few centimetres are enough.
        count: How many poses.
        radius: By how much the board's centre moves along each axis at most, metres.
        tilt: Largest angle by which the board turns about its centre, radians. Half of it is the least.
        seed: Of the random part.
    """
    rng = generator("calibration/poses", seed)
    # Axes spread evenly over the sphere (golden spiral), in random order.
    height = 1 - 2 * (rng.permutation(count) + 0.5) / count
    around = np.pi * (1 + np.sqrt(5)) * count / 2 * (1 - height) + rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - height**2)
    axes = np.column_stack([flat * np.cos(around), flat * np.sin(around), height])
    turns = Rotation.from_rotvec(axes * rng.uniform(tilt / 2, tilt, (count, 1))).as_matrix()
    middle = start[:3, :3] @ centre + start[:3, 3]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turns @ start[:3, :3]
    poses[:, :3, 3] = middle + rng.uniform(-radius, radius, (count, 3)) - poses[:, :3, :3] @ centre
    return list(poses)


def _reading(depth: np.ndarray, column: float, row: float) -> float:
    """Median of the 5 x 5 pixels around a corner, as the surface is flat there; 0 where most have no depth."""
    top, left = round(row) - 2, round(column) - 2
    near = depth[max(top, 0) : top + 5, max(left, 0) : left + 5]
    return float(np.median(near[near > 0])) if np.count_nonzero(near) > 12 else 0.0
