"""The calibration of a fixed camera to the robot's base, from views of a ChArUco board that the flange carries.

It also corrects the camera's depth, which matters more than the camera's pose, and says how far the result is off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from see2act.robot.real.board import ENOUGH, Board
from see2act.robot.real.hand_eye import Fit, Measurements, Model, board_pose, fit, start
from see2act.robot.real.views import View
from see2act.robot.types import RobotError

VIEWS = 12
"""The least number of views."""
GOOD, USABLE = 0.001, 0.003
"""Metres of predicted error up to which a calibration is good, and up to which it may be used."""
TURN = np.radians(5)
"""Radians rms by which the flange must turn about at least two axes. With less, the camera's place is loose."""
MOVE = 0.015
"""Metres rms by which the board must move along at least two axes. With less, its size and all distances are loose."""
FLAT = 1.5
"""Pixels rms by which the corners of one view may be off a flat board: detection gives 0.1 to 0.3."""
FITS = 3.0
"""Pixels rms by which all corners may be off the result. Pose errors of 0.3 mm and 0.5 mrad make 0.65."""
OUTLIER = 4.0
"""A view that is off by this many times the median of the views is dropped."""
READING = 5.0
"""A depth reading that is off by this many standard deviations (from the median) is dropped."""
SQUARE = 0.01
"""Share by which the squares may be off their stated size."""
SCALE = 0.05
"""Share by which the camera's depth may be off. A calibrated stereo camera is within 0.02."""
FOCAL, CENTRE = 0.002, 1.0
"""By how much the camera's focal length (as a share) and principal point (pixels) are off at least: those of a factory. Views
that are left out do not show it."""


@dataclass(frozen=True)
class Calibration:
    """Where the camera is, and how its depth must be corrected."""

    camera: Float[np.ndarray, "4 4"]
    """Camera to base, metres; in the camera's frame x is right, y down and z forward."""
    board: Float[np.ndarray, "4 4"]
    """Board to flange, metres."""
    depth_scale: float
    depth_offset: float
    """Metres. True depth is scale times the camera's depth plus offset."""
    square: float
    """Side of the board's squares by the robot's motions, metres."""
    error: float
    """Predicted error of a pixel with its depth, turned into a point in the base's frame. Metres, rms, without the noise of
    the single reading."""
    pixel_rms: float
    """By how much the corners are off in the images, pixels."""
    views: int
    """How many were used."""
    dropped: dict[int, str]
    """Which of the views given were not used, by index, and why."""

    @property
    def verdict(self) -> str:
        """What the predicted error means, in words."""
        if self.error < GOOD:
            return "good"
        return "usable, but thin or small objects will be missed: calibrate again with more views and more tilt"


def calibrate(
    views: list[View], intrinsics: Float[np.ndarray, "3 3"], board: Board, points: Float[np.ndarray, "n 3"]
) -> Calibration:
    """Find the camera, and the correction of its depth.

    A bundle adjustment of the corners' pixels and depths, in which the flange's poses have errors too. Views that do not fit
    the others are dropped. The error is predicted from how far ``points`` move when views are left out one by one (the
    jackknife), and when the intrinsics are off. A depth error that changes over the image is not in it, nor is one of the
    robot that changes over its workspace: a touch test shows those.

    Args:
        views: As from :func:`seen`; 25 of them are good.
        intrinsics: Pinhole matrix, pixels; the centre of a pixel is at its index.
        board: As it was measured on the print.
        points: Where accuracy matters, metres in the base's frame; as from :func:`bin_points`.

    Raises:
        RobotError: Too few views, or too much alike; the board has another size, is bent or loose; the depth does not fit; or
            the predicted error is above ``USABLE``.
    """
    if not views:
        raise RobotError("no image shows the board: is it in view and in focus, without glare, and the one of the settings?")
    poses, dropped = {}, {}
    for index, view in enumerate(views):
        if len(view.ids) < ENOUGH:
            dropped[index] = f"it shows only {len(view.ids)} corners"
            continue
        poses[index], off = board_pose(board.corners()[view.ids], view.pixels, intrinsics)
        if off > FLAT:
            dropped[index] = f"its corners are {off:.1f} pixels off a flat board"
    kept = _kept(views, dropped)
    flanges, boards = np.array([views[index].flange for index in kept]), np.array([poses[index] for index in kept])
    _demand_variety(flanges, boards @ np.append(board.corners().mean(0), 1))
    model = start(flanges, boards)
    strangers = _strangers(measurements([views[index] for index in kept], intrinsics, board), model)
    while True:
        dropped |= {kept[number]: f"it is {off:.1f} pixels off the others" for number, off in strangers}
        kept = _kept(views, dropped)
        result = fit(*_plausible(measurements([views[index] for index in kept], intrinsics, board), model))
        model = result.model
        strangers = _strangers(result.measurements, model)[:1]  # without it, the others may fit
        if not strangers:
            break
    error, rms = _predicted_error(result, points), _rms(result.measurements.errors(model)[:, :2])
    _demand_fit(result, board, error, rms)
    numbers = model.scale, model.offset, model.square * board.square, error, rms
    return Calibration(model.camera, model.board, *numbers, len(kept), dropped)


def measurements(views: list[View], intrinsics: Float[np.ndarray, "3 3"], board: Board) -> Measurements:
    """All views in one."""
    return Measurements(
        np.array([view.flange for view in views]),
        np.repeat(np.arange(len(views)), [len(view.ids) for view in views]),
        np.concatenate([board.corners()[view.ids] for view in views]),
        np.concatenate([view.pixels for view in views]),
        np.concatenate([view.depth for view in views]),
        intrinsics,
    )


def _kept(views: list[View], dropped: dict[int, str]) -> list[int]:
    kept = [index for index in range(len(views)) if index not in dropped]
    if len(kept) < VIEWS:
        why = "".join(f"; view {index + 1}: {reason}" for index, reason in list(dropped.items())[:3])
        raise RobotError(f"only {len(kept)} of {len(views)} views can be used, and {VIEWS} are needed: take more{why}")
    return kept


def _strangers(m: Measurements, model: Model) -> list[tuple[int, float]]:
    """Views that do not fit the others and by how many pixels, the worst first."""
    errors = m.errors(model)[:, :2]
    off = [_rms(errors[m.view == number]) for number in range(len(m.flanges))]
    limit = OUTLIER * max(float(np.median(off)), 0.25)
    return sorted(((number, value) for number, value in enumerate(off) if value > limit), key=lambda pair: -pair[1])


def _plausible(m: Measurements, model: Model) -> tuple[Measurements, Model]:
    """The measurements without depth readings that cannot be of the board, and the model with a scale for the depth."""
    depth, expected = m.depth, m.in_camera(model)[:, 2]
    there = depth > 0
    if there.mean() < 0.25:
        raise RobotError(
            f"the camera has depth at only {there.mean():.0%} of the board's corners: put the board farther from the camera, "
            "or give it more and softer light"
        )
    scale = float(np.median(expected[there] / depth[there]))
    off = scale * depth - expected
    spread = max(1.48 * float(np.median(np.abs(off[there]))), 0.0005)  # of a normal distribution
    sound = replace(m, depth=np.where(np.abs(off) < READING * spread, depth, 0.0))
    return sound, replace(model, scale=scale, offset=0.0)


def _demand_variety(flanges: Float[np.ndarray, "v 4 4"], centres: Float[np.ndarray, "v 4"]) -> None:
    turns = Rotation.from_matrix(flanges[:, :3, :3])
    turned, moved = (
        np.linalg.svd(values, compute_uv=False) / np.sqrt(len(values))
        for values in ((turns.mean().inv() * turns).as_rotvec(), centres[:, :3] - centres[:, :3].mean(0))
    )
    if turned[1] < TURN:
        raise RobotError(
            f"the flange turned by {np.degrees(turned[0]):.0f} degrees (rms) about one axis and only "
            f"{np.degrees(turned[1]):.0f} about any other: tilt the board by 20 to 40 degrees to both sides, and up and down"
        )
    if moved[1] < MOVE:
        raise RobotError(
            f"the board moved by {1000 * moved[0]:.0f} mm (rms) along one line and only {1000 * moved[1]:.0f} across it: move "
            "it by 100 mm to all sides"
        )


def _demand_fit(result: Fit, board: Board, error: float, rms: float) -> None:
    model = result.model
    if rms > FITS:
        raise RobotError(
            f"the corners are {rms:.1f} pixels off: the board is loose or bent, the arm still moved, or the camera's "
            "intrinsics are of another resolution; mend it and calibrate again"
        )
    if abs(model.square - 1) > max(SQUARE, 3 * result.deviations()[12]):
        raise RobotError(
            f"the squares seem to be {1000 * model.square * board.square:.1f} mm, not {1000 * board.square:.1f}: measure "
            "the board and give --square"
        )
    if abs(model.scale - 1) > SCALE:
        raise RobotError(
            f"the camera's depth would have to be multiplied by {model.scale:.3f}: it is not in metres, or not of the same "
            "pixels as the colour"
        )
    if error > USABLE:
        raise RobotError(
            f"points in the bin would be {1000 * error:.1f} mm off, more than {1000 * USABLE:g}: take more views, with the "
            "board nearer to the bin and with more tilt, to both sides and up and down"
        )


def _predicted_error(result: Fit, points: Float[np.ndarray, "n 3"]) -> float:
    """Metres rms."""
    model, intrinsics = result.model, result.measurements.intrinsics
    pixels, depth = model.in_image(points, intrinsics)
    without = [model.moved(result.step_without(number)) for number in range(len(result.rows))]
    places = np.array([other.in_base(pixels, depth, intrinsics) for other in without])
    squares = (len(without) - 1) * places.var(0).sum(1).mean()  # the jackknife's variance
    for step in result.steps_for_priors():
        squares += ((model.moved(step).in_base(pixels, depth, intrinsics) - points) ** 2).sum(1).mean()
    changes = np.zeros((3, 3, 3))
    changes[0, [0, 1], [0, 1]] = FOCAL * intrinsics[[0, 1], [0, 1]]
    changes[1, 0, 2] = changes[2, 1, 2] = CENTRE
    others = [intrinsics + change for change in changes]
    for other, step, share in zip(others, *result.steps_for(others), strict=True):
        moved = model.moved(step).in_base(pixels, depth, other) - points
        squares += max(1.0, share**2) * (moved**2).sum(1).mean()
    return float(np.sqrt(squares))


def _rms(errors: Float[np.ndarray, "n 2"]) -> float:
    return float(np.sqrt((errors**2).sum(1).mean()))
