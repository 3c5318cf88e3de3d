"""`real.py teach`: a person leads the arm to its places by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from see2act.robot.real import station as stations
from see2act.robot.real import tools
from see2act.robot.real.cell import only_arm
from see2act.robot.real.operator import Operator
from see2act.robot.real.station import Point, Station
from see2act.robot.real.ur import UrArm

JOINTS = {
    "home": "home: where the arm waits, out of the camera's view, with the elbow up",
    "drop": "the drop: beside the bin, where objects are let go",
}
CORNERS = ("near left", "near right", "far left")
"""Of the bin's floor, as seen from the robot, in the order of the station."""
PLACES = (*JOINTS, "bin")


def teach(path: Path, station: Station, operator: Operator, places: Sequence[str] = PLACES) -> Station:
    """Let a person lead the arm, and keep each place in the station's file as soon as it is known.

    The arm gives way to the hand only while a person is asked for a place.

    Args:
        path: Of the station.
        station: What it holds.
        operator: Leads the arm.
        places: Those of :data:`PLACES` to teach.

    Raises:
        RobotError: The arm must not move, or the corners are not those of a rectangle.
    """
    with only_arm(path, station) as arm:
        for name in [place for place in JOINTS if place in places]:
            with arm.led_by_hand():
                operator.ask(f"Lead the arm to {JOINTS[name]}. Then press Enter.")
            robot = station.robot.model_copy(update={name: arm.joints})
            station = _kept(path, station, robot=robot)
        if "bin" in places:
            station = _kept(path, station, bin=_corners(arm, station, operator))
    return station


def _corners(arm: UrArm, station: Station, operator: Operator) -> tuple[Point, Point, Point]:
    tools.point(station.tool, arm)
    corners = []
    for name in CORNERS:
        with arm.led_by_hand():
            operator.ask(f"Touch the bin's floor with the tool's tip in the {name} corner, seen from the robot. Press Enter.")
        corners.append(tuple(float(value) for value in arm.tip[:3, 3]))
    taught: Any = tuple(corners)
    station.model_copy(update={"bin": taught}).world()  # refuses what is no rectangle
    return taught


def _kept(path: Path, station: Station, **values: Any) -> Station:
    station = station.model_copy(update=values)
    stations.save(station, path)
    return station
