"""The devices of a station, connected once in a process and shared by all robots that are built in it."""

from __future__ import annotations

import atexit
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from see2act.robot.real import tools
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.station import Station
from see2act.robot.real.ur import UrArm
from see2act.robot.types import RobotError

log = logging.getLogger("see2act")


class Cell:
    """Arm, tool and camera, ready for use. Get it from :func:`connected`.

    Args:
        station: Of the lab.
        camera: Not yet open.
        lock: Held while the cell is connected: two programs must not move one arm.
    """

    def __init__(self, station: Station, camera: DepthCamera, lock: FileLock):
        self.arm = UrArm(station)
        self.tool = tools.build(station.tool, self.arm)
        self.camera = camera
        self._lock = lock
        try:
            camera.open()
            self.arm.connect()
            self.tool.connect()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Disconnect everything. The tool keeps what it holds."""
        self.tool.close()
        self.arm.close()
        self.camera.close()
        self._lock.release()


_cells: dict[Path, Cell] = {}


def connected(path: Path, station: Station, camera: DepthCamera) -> Cell:
    """The cell of a station, connected at the first call.

    Robots are built in several places of a run, one after another; a controller takes commands from one client at a time.

    Args:
        path: Of the station, by which the cell is known.
        station: What it holds.
        camera: Opened at the first call; later ones use that one.

    Raises:
        RobotError: A device does not answer, or another program uses the station.
    """
    path = path.absolute()
    if path not in _cells:
        _cells[path] = Cell(station, camera, _locked(path))
        log.info("connected to %s at %s", station.tool.kind, station.robot.host)
    return _cells[path]


@atexit.register
def disconnect() -> None:
    """Close all cells; called at the end of the program too."""
    while _cells:
        _cells.popitem()[1].close()


@contextmanager
def only_arm(path: Path, station: Station) -> Iterator[UrArm]:
    """The arm of a station alone, connected in the block.

    Raises:
        RobotError: It does not answer or must not move, or another program uses the station.
    """
    lock, arm = _locked(path.absolute()), UrArm(station)
    try:
        arm.connect()
        yield arm
    finally:
        arm.close()
        lock.release()


@contextmanager
def only_camera(camera: DepthCamera) -> Iterator[DepthCamera]:
    """A camera, open in the block."""
    try:
        camera.open()
        yield camera
    finally:
        camera.close()


def _locked(path: Path) -> FileLock:
    lock = FileLock(f"{path}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RobotError(f"another program uses the station {path}: wait for it to end") from None
    return lock
