"""Pictures for the floor of the bin: a material with flat pictures of objects printed on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from see2act.robot.objects import Shape, random_color, random_rotation

PER_METRE = 1000
"""Pixels per metre; a heightmap has 400 to 800."""
LIGHT = np.array([0.3, 0.4, 0.87])
"""Direction to the light in which printed objects are shown, a unit vector."""
AMBIENT = 0.55
"""Brightness of faces that the light does not reach."""

Picture = Float[np.ndarray, "h w 3"]


def floor_picture(
    rng: np.random.Generator, width: float, length: float, printed: Sequence[Shape] = ()
) -> UInt8[np.ndarray, "h w 3"]:
    """An RGB picture of a floor seen from above, with x to the right and y up.

    Args:
        rng: Chooses the material and its colours, and the position, orientation and colour of printed objects.
        width, length: Extent along x and y, metres.
        printed: Shapes whose pictures are printed on the floor, at scale 1.
    """
    rows, cols = round(length * PER_METRE), round(width * PER_METRE)
    material = MATERIALS[rng.integers(len(MATERIALS))]
    picture = (material(rng, rows, cols).clip(0, 1) * 255).astype(np.uint8)
    for shape in printed:
        _print(picture, shape, random_rotation(rng), np.array(random_color(rng)), rng.uniform(0, 1, 2) * (cols, rows))
    return picture


def _print(picture: np.ndarray, shape: Shape, rotation: np.ndarray, color: np.ndarray, at: np.ndarray) -> None:
    """Draw a shape as seen from above, with its middle at column and row ``at``."""
    turn = Rotation.from_quat(rotation).as_matrix()
    triangles = np.concatenate([part.triangles for part in shape.parts]) @ turn.T
    normals = np.concatenate([part.face_normals for part in shape.parts]) @ turn.T
    for i in np.argsort(triangles[:, :, 2].mean(axis=1), kind="stable"):  # the highest last, so that they cover the lower ones
        if normals[i, 2] > 0:
            corners = at + triangles[i, :, :2] * (PER_METRE, -PER_METRE)
            shade = AMBIENT + (1 - AMBIENT) * max(0.0, float(normals[i] @ LIGHT))
            cv2.fillConvexPoly(picture, np.round(corners).astype(np.int32), (255 * shade * color).tolist(), cv2.LINE_AA)


def _wood(rng: np.random.Generator, rows: int, cols: int) -> Picture:
    """Wooden boards with the grain along x."""
    board = int(rng.integers(40, 120))
    grain = _clouds(rng, rows, cols, (3, 150)) + 0.5 * _clouds(rng, rows, cols, (2, 40))
    tone = rng.uniform(-0.25, 0.25, rows // board + 1)[np.arange(rows) // board][:, None]
    picture = _between(np.array((0.36, 0.22, 0.12)), np.array((0.80, 0.62, 0.42)), 0.5 + 0.25 * grain + tone)
    picture[np.arange(rows) % board < 2] *= 0.4
    return picture


def _stone(rng: np.random.Generator, rows: int, cols: int) -> Picture:
    """Marble with veins, in two colours."""
    clouds = sum(0.5**k * _clouds(rng, rows, cols, (100 >> k, 100 >> k)) for k in range(5))
    veins = np.abs(np.sin(3 * clouds)) ** 0.3
    return _between(rng.uniform(0.1, 0.5, 3), rng.uniform(0.5, 0.95, 3), veins)


def _cloth(rng: np.random.Generator, rows: int, cols: int) -> Picture:
    """A checked weave in two random colours."""
    check = int(rng.integers(15, 50))
    row, col = np.indices((rows, cols))
    weave = 0.12 * np.sin(row * np.pi / 2) * np.sin(col * np.pi / 2) + 0.04 * _clouds(rng, rows, cols, (1, 1))
    stripes = ((row // check % 2) + (col // check % 2)) / 2
    return _between(rng.uniform(0.05, 0.9, 3), rng.uniform(0.05, 0.9, 3), stripes + weave)


def _tiles(rng: np.random.Generator, rows: int, cols: int) -> Picture:
    """Square tiles of different shades, and the joints between them."""
    side = int(rng.integers(25, 70))
    row, col = np.indices((rows, cols))
    shade = rng.uniform(0.6, 1.1, (rows // side + 1, cols // side + 1))[row // side, col // side]
    picture = shade[..., None] * rng.uniform(0.2, 0.9, 3) + 0.03 * _clouds(rng, rows, cols, (2, 2))[..., None]
    picture[(row % side < 3) | (col % side < 3)] = rng.uniform(0.2, 0.8)
    return picture


def _chips(rng: np.random.Generator, rows: int, cols: int) -> Picture:
    """Terrazzo: chips of stone in four colours in cement."""
    picture = np.full((rows, cols, 3), rng.uniform(0.4, 0.8))
    colors = rng.uniform(0.1, 0.95, (4, 3))
    for _ in range(rows * cols // 400):
        corners = rng.uniform(0, 1, 2) * (cols, rows) + rng.uniform(2, 14) * rng.uniform(-1, 1, (5, 2))
        hull = cv2.convexHull(np.round(corners).astype(np.int32))
        cv2.fillConvexPoly(picture, hull, colors[rng.integers(4)].tolist(), cv2.LINE_AA)
    return picture


MATERIALS: list[Callable[[np.random.Generator, int, int], Picture]] = [_wood, _stone, _cloth, _tiles, _chips]
"""Functions of a generator, rows and columns that make RGB pictures in 0..1. Values outside this range are clipped."""


def _clouds(rng: np.random.Generator, rows: int, cols: int, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Smooth noise with a variance of about 0.7 (1 for single pixels), in blobs of ``size`` (height and width in pixels)."""
    coarse = rng.standard_normal((rows // size[0] + 2, cols // size[1] + 2)).astype(np.float32)
    smooth = cv2.resize(coarse, (coarse.shape[1] * size[1], coarse.shape[0] * size[0]), interpolation=cv2.INTER_CUBIC)
    return smooth[:rows, :cols]


def _between(one: np.ndarray, other: np.ndarray, share: Float[np.ndarray, "h w"]) -> Picture:
    """Mix two colours by ``share``, from all of ``one`` (0) to all of ``other`` (1)."""
    picture: np.ndarray = one + share.clip(0, 1)[..., None] * (other - one)
    return picture
