"""`real.py touch`: the tip goes to points that the camera sees, and a person says how far off it is."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from see2act.robot.arm import HOME_ANGLE
from see2act.robot.real import station as stations
from see2act.robot.real import tools
from see2act.robot.real.board import Board
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import only_arm, only_camera
from see2act.robot.real.operator import Operator
from see2act.robot.real.projection import Projection
from see2act.robot.real.routes import Routes
from see2act.robot.real.setup.clock import today
from see2act.robot.real.station import Station, TouchSection
from see2act.robot.real.views import seen
from see2act.robot.types import RobotError

GAP = 0.005
"""Metres above a point at which the tip stops: nothing is touched if the calibration is within it."""
POINTS = 5
"""Points of the board that are visited: its middle, and the corners next to its own four."""
ANSWER = r"(\d+(?:\.\d+)?)\s+(-?\d+(?:\.\d+)?)"


def touch(
    path: Path,
    station: Station,
    camera: DepthCamera,
    board: Board,
    operator: Operator,
    routes: dict[str, float],
    contact_limit: float,
) -> Station:
    """Visit corners of a board that lies in the bin, and keep the largest offset in the station.

    Args:
        path: Of the station.
        station: Taught and calibrated.
        camera: Not open.
        board: Lies on the bin's floor.
        operator: Measures.
        routes: Clearance and speeds; see :class:`Routes`.
        contact_limit: Newtons at which a descent stops.

    Raises:
        RobotError: A device fails, the tip touches something, or the camera is not the calibrated one.
    """
    station.demand("home", "bin", "calibration")
    projection = Projection(station)
    with only_camera(camera), only_arm(path, station) as arm:
        station.demand_camera(camera.serial)
        ways = Routes(arm, station, operator, **routes)
        ways.refuse_out_of_reach()
        ways.home()
        tools.point(station.tool, arm)
        points = _points(camera, board, operator, projection)
        offsets = []
        ways.to_gate()
        for number, (x, y, z) in enumerate(points, start=1):
            ways.above(x, y, HOME_ANGLE)
            if force := ways.down(x, y, max(z, 0.0) + GAP, HOME_ANGLE, contact_limit):
                ways.up()
                raise RobotError(
                    f"the tip touched something ({force:.0f} N) more than {1000 * GAP:g} mm above a point that the camera "
                    "sees: look at tool.tip in the station, and calibrate again"
                )
            sideways, gap = _measured(operator, number, len(points))
            offsets.append(float(np.hypot(sideways, gap - GAP)))
            ways.up()
        ways.back_to_gate()
        ways.home()
    assert station.calibration is not None
    section = TouchSection(offset=max(offsets), serial=station.calibration.serial, date=today())
    station = station.model_copy(update={"touch": section})
    stations.save(station, path)
    return station


def _points(camera: DepthCamera, board: Board, operator: Operator, projection: Projection) -> list[Float[np.ndarray, "3"]]:
    """Places in the world of the board's corners, as the camera sees them."""
    trouble = "Lay the board flat on the bin's floor, in the middle, and step back."
    columns, rows = board.columns - 1, board.rows - 1  # of inner corners
    last = columns * rows - 1
    wanted = [0, columns - 1, rows // 2 * columns + columns // 2, last - columns + 1, last]
    while True:
        operator.ask(f"{trouble} Then press Enter.")
        frame = camera.read()
        view = seen(np.eye(4), frame.color, frame.depth, board)
        found = {} if view is None else {int(i): k for k, i in enumerate(view.ids) if view.depth[k] > 0}
        if view is not None and all(i in found for i in wanted):
            return [projection.point(view.pixels[found[i]], float(view.depth[found[i]]), camera.intrinsics) for i in wanted]
        trouble = "The camera does not see all corners of the board with their depth. Move it, or see to the light."


def _measured(operator: Operator, number: int, count: int) -> tuple[float, float]:
    """Metres that the tip is off sideways, and above the board, as a person reads them."""
    request = (
        f"Point {number} of {count}: the tip should be {1000 * GAP:g} mm above a corner of the chessboard. How many "
        "millimetres is it off sideways, and how many above the board? Type two numbers, such as 0.5 4"
    )
    while True:
        answer = re.fullmatch(ANSWER, operator.ask(request).replace(",", "."))
        if answer:
            return float(answer[1]) / 1000, float(answer[2]) / 1000
        request = "Type two numbers in millimetres with a space between them: sideways, and above the board."
