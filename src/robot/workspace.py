"""The grid over the bin: converts pixels to world points and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from see2act.robot.types import Heightmap, Pick, RobotError

Pixels = TypeVar("Pixels", float, np.ndarray)
LARGEST = 10**6
"""Pixels of the largest heightmap."""


@dataclass(frozen=True)
class Workspace:
    """A rectangle on the bin's floor, centred on the world's origin and divided into square pixels.

    Args:
        name: Name used in the configuration.
        width: Extent along x, metres.
        length: Extent along y, metres.
        pixel: Side of a pixel, metres.
        robot_x: World x of the robot's base, chosen so that the whole rectangle is within reach, metres.

    Raises:
        RobotError: A length is not above 0, an extent is not a whole number of pixels, or there are more than ``LARGEST``.
    """

    name: str
    width: float
    length: float
    pixel: float
    robot_x: float = -0.45

    def __post_init__(self) -> None:
        if not (self.pixel > 0 and 0 < min(self.width, self.length) <= max(self.width, self.length) < math.inf):
            raise RobotError(f"workspace.width, length and pixel must be positive metres, got {self}")
        for key in ("width", "length"):
            metres = getattr(self, key)
            count = metres / self.pixel
            if abs(count - round(count)) > 1e-6:
                raise RobotError(
                    f"workspace.{key}={metres} is {count:.2f} pixels of {self.pixel} m: give {round(count) * self.pixel:.6g}"
                )
        if math.prod(self.shape) > LARGEST:
            raise RobotError(
                f"workspace.width={self.width}, length={self.length} and pixel={self.pixel} give {self.shape[0]} x "
                f"{self.shape[1]} pixels, more than {LARGEST}: give a larger workspace.pixel"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the heightmap."""
        return round(self.length / self.pixel), round(self.width / self.pixel)

    def to_world(self, row: Pixels, col: Pixels) -> tuple[Pixels, Pixels]:
        """World x and y of pixel centres, metres."""
        x = -self.width / 2 + (col + 0.5) * self.pixel
        y = self.length / 2 - (row + 0.5) * self.pixel
        return x, y

    def to_pixel(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column (int) of the pixel that contains each world point. It may lie outside the grid."""
        col = np.floor((np.asarray(x) + self.width / 2) / self.pixel).astype(int)
        row = np.floor((self.length / 2 - np.asarray(y)) / self.pixel).astype(int)
        return row, col

    def pick(self, heightmap: Heightmap, row: int, col: int, angle: float) -> Pick:
        """The pick at a pixel of ``heightmap``.

        Raises:
            RobotError: The pixel lies outside the heightmap.
        """
        rows, cols = heightmap.height.shape
        if not (0 <= row < rows and 0 <= col < cols):
            raise RobotError(f"pixel ({row}, {col}) lies outside the {rows} x {cols} heightmap")
        x, y = self.to_world(row, col)
        return Pick(int(row), int(col), float(angle), x, y, float(heightmap.height[row, col]))
