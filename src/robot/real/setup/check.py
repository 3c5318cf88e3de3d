"""`real.py check`: read everything of a station, move nothing, and say what is missing or wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from typing import Literal

import numpy as np

from see2act.robot.real import tools
from see2act.robot.real.calibration import GOOD, USABLE
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import only_arm, only_camera
from see2act.robot.real.operator import Terminal
from see2act.robot.real.routes import AT_HOME, Routes
from see2act.robot.real.station import CLEAN, WRITTEN_BY, Station
from see2act.robot.real.ur import UrArm
from see2act.robot.types import RobotError

PACKAGES = ("ur-rtde", "pyrealsense2", "pymodbus", "opencv-python-headless")
READINGS = 0.5
"""Share of the pixels with depth below which something is wrong with the camera."""


@dataclass(frozen=True)
class Verdict:
    """One line of a check."""

    part: str
    verdict: Literal["ok", "to do", "FAILED"]
    text: str


def check(path: Path, station: Station, camera: DepthCamera, routes: dict[str, float]) -> Iterator[Verdict]:
    """Look at each part of a station. Nothing moves, and no tool is switched.

    Args:
        path: Of the station.
        station: What it holds.
        camera: Not open.
        routes: Clearance and speeds; see :class:`Routes`.
    """
    for package in PACKAGES:
        yield _package(package)
    yield from _steps(station)
    found = _tried("controller", lambda: _controller(station))
    yield found
    if found.verdict == "ok":
        yield from _arm(path, station, routes)
    yield from _camera(station, camera)


def _package(name: str) -> Verdict:
    try:
        return Verdict(name, "ok", version(name))
    except PackageNotFoundError:
        return Verdict(name, "FAILED", "not installed: pip install 'see2act[real]'")


def _steps(station: Station) -> Iterator[Verdict]:
    """What the commands have written."""
    for part in station.missing():
        yield Verdict(part, "to do", f"type `python real.py {WRITTEN_BY[part]}`")
    if station.bin:
        yield _tried("bin", lambda: "{:.0f} x {:.0f} mm".format(*(1000 * side for side in station.bin_size())))
    if calibration := station.calibration:
        quality = "good" if calibration.error < GOOD else "usable" if calibration.error < USABLE else "too bad"
        text = f"{1000 * calibration.error:.2f} mm predicted error, {quality}; of {calibration.date}, {calibration.serial}"
        yield Verdict("calibration", "ok" if calibration.error < USABLE else "FAILED", text)
    if touch := station.touch:
        text = f"{1000 * touch.offset:.1f} mm off at most, of {touch.date}"
        if not station.trusted:
            text += f": all motion is slow. Calibrate again until it is within {1000 * CLEAN:g} mm"
        yield Verdict("touch", "ok" if station.trusted else "to do", text)


def _controller(station: Station) -> str:
    arm = UrArm(station)
    try:
        arm.connect(control=False)
        status = arm.status()
    finally:
        arm.close()
    if reason := status.objection():
        raise RobotError(f"PolyScope {status.version} at {station.robot.host}: {reason}")
    return (
        f"PolyScope {status.version} at {station.robot.host}, {status.robot_mode}, safety {status.safety_mode}, slider "
        f"{status.slider:.0%}"
    )


def _arm(path: Path, station: Station, routes: dict[str, float]) -> Iterator[Verdict]:
    """What is known only with command of the arm: reach, and tools that use its signals."""
    try:
        with only_arm(path, station) as arm:
            if station.bin and station.robot.home:
                home = station.robot.home
                yield _tried("reach", lambda: _reach(arm, station, routes))
                off = float(np.abs(np.subtract(home, arm.joints)).max())
                yield Verdict("arm", "ok", "at home" if off < AT_HOME else f"{np.degrees(off):.0f} degrees from home")
            yield from _tool(station, arm)
    except RobotError as error:
        yield Verdict("arm", "FAILED", str(error))


def _reach(arm: UrArm, station: Station, routes: dict[str, float]) -> str:
    Routes(arm, station, Terminal(), **routes).refuse_out_of_reach()
    return "all corners of the bin, on its floor and above it"


def _tool(station: Station, arm: UrArm) -> Iterator[Verdict]:
    tool = tools.build(station.tool, arm)
    try:
        tool.connect()
        for line in tool.check():
            yield Verdict(station.tool.kind, "ok", line)
    except RobotError as error:
        yield Verdict(station.tool.kind, "FAILED", str(error))
    finally:
        tool.close()


def _camera(station: Station, camera: DepthCamera) -> Iterator[Verdict]:
    try:
        with only_camera(camera):
            begin = monotonic()
            depth = camera.read().depth
            seconds, share = monotonic() - begin, float((depth > 0).mean())
            text = f"{camera.serial}, {depth.shape[1]} x {depth.shape[0]}, depth in {share:.0%} of the pixels, {seconds:.1f} s"
            yield Verdict("camera", "ok" if share > READINGS else "FAILED", text)
            if station.calibration:
                station.demand_camera(camera.serial)
                if station.calibration.size != depth.shape[::-1]:
                    raise RobotError(
                        f"it was calibrated at {station.calibration.size[0]} x {station.calibration.size[1]}: set that "
                        "resolution, or calibrate again"
                    )
    except RobotError as error:
        yield Verdict("camera", "FAILED", str(error))


def _tried(part: str, look: Callable[[], str]) -> Verdict:
    try:
        return Verdict(part, "ok", look())
    except RobotError as error:
        return Verdict(part, "FAILED", str(error))
