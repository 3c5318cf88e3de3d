"""`real.py calibrate`: the arm shows the board to the camera from many sides, and the camera's place is computed."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from see2act.files import replacing
from see2act.robot.real import station as stations
from see2act.robot.real.board import Board
from see2act.robot.real.box import Box
from see2act.robot.real.calibration import VIEWS, Calibration
from see2act.robot.real.calibration import calibrate as computed
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import only_arm, only_camera
from see2act.robot.real.controller import OutOfReach
from see2act.robot.real.operator import Operator
from see2act.robot.real.setup.clock import now, today
from see2act.robot.real.station import CalibrationSection, Station
from see2act.robot.real.ur import UrArm
from see2act.robot.real.views import View, bin_points, propose, seen
from see2act.robot.types import RobotError

WANTED = 25
"""Views. `python -m benchmarks.calibration` shows what more and fewer do."""
PROPOSED = 100
"""Poses of which those are tried, until there are enough views, that the arm can reach and that stay above the bin."""
SPEED = 0.1
"""m/s of the tip between poses; a quarter of it before a clean touch test."""
REST = 0.5
"""Seconds at a pose before the image: the arm and what it carries still swing."""
FREE = 0.02
"""Metres that the tool's tip and the board stay above the bin's floor."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class Recording:
    """What a calibration is computed from, kept so that it can be computed again."""

    views: list[View]
    intrinsics: Float[np.ndarray, "3 3"]
    """Pinhole matrix of the camera, pixels."""
    serial: str
    """Of the camera."""
    size: tuple[int, int]
    """Columns and rows of its images."""
    board: Board

    def save(self, path: Path) -> None:
        """Write atomically."""
        counts = [len(view.ids) for view in self.views]
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                flanges=np.array([view.flange for view in self.views]),
                ends=np.cumsum(counts),
                ids=np.concatenate([view.ids for view in self.views]),
                pixels=np.concatenate([view.pixels for view in self.views]),
                depth=np.concatenate([view.depth for view in self.views]),
                intrinsics=self.intrinsics,
                serial=np.array(self.serial),
                size=np.array(self.size),
                board=np.array([self.board.columns, self.board.rows, self.board.square]),
            )

    @classmethod
    def load(cls, path: Path) -> Recording:
        """Read what :meth:`save` wrote.

        Raises:
            RobotError: It is not there, or is another file.
        """
        try:
            with np.load(path) as arrays:
                starts = [0, *arrays["ends"][:-1]]
                parts = [slice(*pair) for pair in zip(starts, arrays["ends"], strict=True)]
                views = [
                    View(flange, arrays["ids"][part], arrays["pixels"][part], arrays["depth"][part])
                    for flange, part in zip(arrays["flanges"], parts, strict=True)
                ]
                columns, rows, square = arrays["board"]
                board = Board(int(columns), int(rows), float(square))
                cols, height = (int(side) for side in arrays["size"])
                return cls(views, arrays["intrinsics"], str(arrays["serial"]), (cols, height), board)
        except Exception as error:  # zipfile, zlib and numpy each have their own
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise RobotError(f"{path} holds no views of a calibration ({reason}): give a file that calibrate wrote") from None


def record(
    path: Path,
    station: Station,
    camera: DepthCamera,
    board: Board,
    centre: Float[np.ndarray, "3"],
    operator: Operator,
    say: Say,
) -> Recording:
    """Let the arm carry the board about before the camera.

    Args:
        path: Of the station.
        station: With a bin.
        camera: Not open.
        board: In the tool, or at the flange.
        centre: Of the board, in the frame of the flange, metres, to a few centimetres.
        operator: Brings the board before the camera.
        say: Is told of each pose.

    Returns:
        What the camera saw. It is kept in a file beside the station's, even if a device fails on the way.

    Raises:
        RobotError: A device fails, the arm can reach too few poses, or none shows the board.
    """
    station.demand("bin")
    kept = path.parent / f"calibration-{now()}.npz"
    box = _box(station)
    with only_camera(camera), only_arm(path, station) as arm:
        first = _first_pose(arm, camera, board, operator, station.tool.tip, box)
        proposed = [p for p in propose(first, centre, PROPOSED) if not _touches_floor(p, centre, board, box)]
        poses = _reachable(arm, station.tool.tip, proposed, box)
        if len(poses) < VIEWS:
            raise RobotError(
                f"the arm can reach only {len(poses)} of {PROPOSED} poses around the present one without leaving the bin's "
                "sides: hold the board nearer to the middle of the bin, about 20 cm above its floor"
            )
        operator.ask(
            f"The arm will now show the board from {WANTED} sides, slowly, above the bin. Step back, and keep a hand at the "
            "emergency stop. Then press Enter."
        )
        recording = Recording([], camera.intrinsics, camera.serial, _size(camera), board)
        try:
            for number, pose in enumerate(poses, start=1):
                arm.move_line(pose, SPEED, box)
                time.sleep(REST)
                view = seen(_flange(arm, station.tool.tip), *_image(camera), board)
                if view:
                    recording.views.append(view)
                say(f"pose {number}: {f'{len(view.ids)} corners' if view else 'the board is not seen'}")
                if len(recording.views) == WANTED:
                    break
            arm.move_line(first @ _along_z(station.tool.tip), SPEED, box)
        finally:
            if recording.views:
                recording.save(kept)
                say(f"{len(recording.views)} views are in {kept}")
    if not recording.views:
        raise RobotError("no image shows the board: is it in focus, without glare, and the one of --columns and --rows?")
    return recording


def use(path: Path, station: Station, recording: Recording) -> tuple[Station, Calibration]:
    """Compute a calibration and write it into the station. Its touch test no longer counts.

    Raises:
        RobotError: The views do not give a good one; see :func:`see2act.robot.real.calibration.calibrate`.
    """
    points = bin_points(station.world(), station.bin_size())
    found = computed(recording.views, recording.intrinsics, recording.board, points)
    section = CalibrationSection(
        serial=recording.serial,
        size=recording.size,
        camera=found.camera.tolist(),
        depth_scale=found.depth_scale,
        depth_offset=found.depth_offset,
        error=found.error,
        views=found.views,
        date=today(),
    )
    station = station.model_copy(update={"calibration": section, "touch": None})
    stations.save(station, path)
    return station, found


def _first_pose(
    arm: UrArm, camera: DepthCamera, board: Board, operator: Operator, tip: float, box: Box
) -> Float[np.ndarray, "4 4"]:
    """The pose of the flange to which a person has led the arm, and from which the camera sees the board."""
    trouble = "Fix the board to the flange or in the tool, so that it faces the camera while the tool points down."
    while True:
        with arm.led_by_hand():
            operator.ask(
                f"{trouble} Lead the arm until the board faces the camera, in the middle of its image and 20 cm above the "
                "bin's floor. Then press Enter."
            )
        flange = _flange(arm, tip)
        if reason := box.objection(arm.tip[:3, 3]):
            trouble = f"The tip is {reason}, or nearly."
        elif not seen(flange, *_image(camera), board):
            trouble = "The camera does not see the board, or not enough of it; see to light and focus too."
        else:
            return flange


def _box(station: Station) -> Box:
    """Above the bin's floor, by a little more than a hand-held tool would go."""
    box = Box.above(station)
    return replace(box, low=np.array([*box.low[:2], FREE]))


def _touches_floor(flange: Float[np.ndarray, "4 4"], centre: Float[np.ndarray, "3"], board: Board, box: Box) -> bool:
    """Whether a board could be nearer than :data:`FREE` to the bin's floor, however it is turned about its middle."""
    middle = (np.linalg.inv(box.world) @ flange @ np.append(centre, 1))[2]
    return bool(middle < board.square * np.hypot(board.columns, board.rows) / 2 + FREE)


def _reachable(arm: UrArm, tip: float, flanges: list[Float[np.ndarray, "4 4"]], box: Box) -> list[Float[np.ndarray, "4 4"]]:
    """Poses of the tip in the box that the controller can reach."""
    poses: list[Float[np.ndarray, "4 4"]] = []
    for pose in (flange @ _along_z(tip) for flange in flanges):
        if box.objection(pose[:3, 3]) is None:
            with suppress(OutOfReach):
                arm.refuse_out_of_reach(pose)
                poses.append(pose)
    return poses


def _image(camera: DepthCamera) -> tuple[np.ndarray, np.ndarray]:
    frame = camera.read()
    return frame.color, frame.depth


def _size(camera: DepthCamera) -> tuple[int, int]:
    rows, cols = camera.read().depth.shape
    return cols, rows


def _flange(arm: UrArm, tip: float) -> Float[np.ndarray, "4 4"]:
    return arm.tip @ _along_z(-tip)


def _along_z(metres: float) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[2, 3] = metres
    return pose
