"""`real.py background`: images of the empty bin, and whether its floor is seen where it was taught."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from see2act.files import write_arrays
from see2act.robot import heightmap as hm
from see2act.robot.real import station as stations
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import only_arm, only_camera
from see2act.robot.real.frames import median_color, median_depth
from see2act.robot.real.operator import Operator
from see2act.robot.real.projection import Projection
from see2act.robot.real.routes import Routes
from see2act.robot.real.setup.clock import today
from see2act.robot.real.station import Station
from see2act.robot.types import RobotError
from see2act.robot.workspace import Workspace

READINGS = 5
"""Images of the camera, each a median itself, of which the background is the median."""
SEEN = 0.8
"""Share of the bin's floor that the camera must see."""
LEVEL, TOO_FAR = 0.003, 0.010
"""Metres by which the floor may be seen above or below its taught height without a word, and before it is refused."""


@dataclass(frozen=True)
class Floor:
    """How the empty bin is seen."""

    seen: float
    """Share of the heightmap's cells with a reading, or next to one."""
    height: float
    """Median of the cells in metres, against the taught floor."""
    spread: float
    """Metres between the lowest and the highest twentieth: tilt, curvature and noise."""

    def objection(self) -> str | None:
        """What is wrong with it and what to do; None if nothing is."""
        if self.seen < SEEN:
            return f"the camera sees only {self.seen:.0%} of the bin's floor: turn it, and calibrate again"
        if abs(self.height) > LEVEL or self.spread > 4 * LEVEL:
            return (
                f"the floor is seen {1000 * self.height:+.1f} mm from where it was taught, and uneven by "
                f"{1000 * self.spread:.1f} mm: teach the bin again, or calibrate again"
            )
        return None


def background(
    path: Path, station: Station, camera: DepthCamera, workspace: Workspace, operator: Operator, routes: dict[str, float]
) -> tuple[Station, Floor]:
    """Take images of the empty bin and keep them beside the station's file.

    Args:
        path: Of the station.
        station: Taught and calibrated.
        camera: Not open.
        workspace: Grid in which the floor is judged.
        operator: Empties the bin.
        routes: Clearance and speeds; see :class:`Routes`.

    Raises:
        RobotError: The camera is not the calibrated one, or the floor is not where it was taught.
    """
    station.demand("home", "bin", "calibration")
    projection = Projection(station)
    with only_camera(camera):
        station.demand_camera(camera.serial)
        with only_arm(path, station) as arm:
            Routes(arm, station, operator, **routes).home()
            operator.ask("Empty the bin, in the light in which the robot will work, and step back. Then press Enter.")
            frames = [camera.read() for _ in range(READINGS)]
        color, depth = median_color([frame.color for frame in frames]), median_depth([frame.depth for frame in frames])
        intrinsics = camera.intrinsics
    heightmap = projection.heightmap(color, depth, intrinsics, workspace)
    low, middle, high = np.quantile(heightmap.height[heightmap.valid], (0.05, 0.5, 0.95))
    floor = Floor(float(hm.fill(heightmap.valid)[1].mean()), float(middle), float(high - low))
    if floor.seen < SEEN or abs(floor.height) > TOO_FAR:
        raise RobotError(str(floor.objection()))
    name = f"background-{today()}.npz"
    write_arrays(path.parent / name, {"color": color, "depth": depth, "intrinsics": intrinsics})
    station = station.model_copy(update={"background": name})
    stations.save(station, path)
    return station, floor
