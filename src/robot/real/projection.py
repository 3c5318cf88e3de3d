"""From a station's images to points and heightmaps in the frame of its bin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from see2act.robot import heightmap as hm
from see2act.robot.real.station import Station
from see2act.robot.types import Heightmap
from see2act.robot.workspace import Workspace

CENTRE = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From pixel centres at the index, as cameras give intrinsics, to centres at the index and a half, as heightmaps take them."""


class Projection:
    """What a calibrated station makes of its images.

    Args:
        station: With a bin and a calibration.

    Raises:
        RobotError: It has none.
    """

    def __init__(self, station: Station):
        station.demand("bin", "calibration")
        assert station.calibration is not None
        self._calibration = station.calibration
        self._pose = np.linalg.inv(station.world()) @ np.array(station.calibration.camera)
        """Camera to world."""

    def depth(self, raw: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """True depth by the calibration, metres, float32; 0 stays 0."""
        true = self._calibration.depth_scale * raw + self._calibration.depth_offset
        return np.where(raw > 0, true, 0).astype(np.float32)

    def heightmap(
        self,
        color: UInt8[np.ndarray, "h w 3"],
        raw: Float[np.ndarray, "h w"],
        intrinsics: Float[np.ndarray, "3 3"],
        workspace: Workspace,
    ) -> Heightmap:
        """Heightmap of the bin.

        Args:
            color: RGB.
            raw: Depth as the camera gives it, metres.
            intrinsics: Pinhole matrix, pixels; the centre of a pixel is at its index.
            workspace: Grid of the heightmap.
        """
        depth = self.depth(raw)
        return hm.project(color, depth, hm.point_cloud(depth, intrinsics + CENTRE, self._pose), workspace)

    def point(self, pixel: Float[np.ndarray, "2"], raw: float, intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
        """The place in the world, metres, that is seen at a pixel (column, row) with a depth as the camera gives it."""
        depth = float(self.depth(np.array([[raw]]))[0, 0])
        seen = depth * np.linalg.solve(intrinsics, np.append(pixel, 1))
        return self._pose[:3, :3] @ seen + self._pose[:3, 3]
