"""How far off the calibration of a real camera is, and whether it knows: ways to calibrate, and stations, that are computed.

The board's corners, the depth, the robot's poses and the camera's intrinsics have errors as at a real station. A row's errors
are those of points on the bin's floor and 4 cm above, in millimetres rms: over all seeds, and in the worst; and the predicted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.common import at_least_one, finish, spread
from see2act.robot.real.board import Board
from see2act.robot.real.calibration import calibrate, measurements
from see2act.robot.real.hand_eye import Model, Noise, board_pose, fit, start
from see2act.robot.real.views import View, bin_points, propose
from see2act.seeding import generator

SIZE = (1280, 720)
INTRINSICS = np.array([[930.0, 0, 639.5], [0, 930, 359.5], [0, 0, 1]])
"""Of a RealSense D415."""
BASELINE = 0.055
"""Of the same, metres."""
PLACE = np.array([0.45, 0.0, 0.0])
"""Middle of the bin's floor in the frame of the robot's base, metres."""
BIN = (0.36, 0.26)
"""Metres."""
ABOVE = 0.12
"""Of the board over the floor in the middle of its poses, metres."""


@dataclass(frozen=True)
class Errors:
    """Errors of a station: standard deviations, and then what is the same at every seed."""

    pixel: float = 0.2
    disparity: float = 0.08
    """Pixels."""
    position: float = 3e-4
    rotation: float = 5e-4
    """Of the robot's poses, metres and radians."""
    focal: float = 0.002
    """Share."""
    centre: float = 1.0
    """Pixels."""
    shared: float = 0.0
    """Of the depth of a whole view, metres."""
    scale: float = 1.005
    offset: float = 0.0
    bend: float = 0.0
    """The camera measures scale times depth plus offset plus bend times the depth's square, metres."""
    square: float = 1.0
    """True size of the squares as a share of the stated one."""

    def depth(self, true: np.ndarray) -> np.ndarray:
        """What the camera measures, without noise."""
        return self.scale * true + self.offset + self.bend * true**2


@dataclass(frozen=True)
class Case:
    """A station of which everything is known."""

    errors: Errors
    board: Board
    views: list[View]
    intrinsics: Float[np.ndarray, "3 3"]
    """As the camera states them."""
    points: Float[np.ndarray, "n 3"]
    """On the bin's floor and above, metres, in the base's frame."""
    camera: Float[np.ndarray, "4 4"]
    """Camera to base."""
    boards: list[Float[np.ndarray, "4 4"]]
    """Board to camera, of each view."""

    def error(self, camera: np.ndarray, scale: float = 1.0, offset: float = 0.0) -> float:
        """Metres rms by which points are off that are made from true pixels and depths without noise."""
        true = Model(self.camera, np.eye(4))
        pixels, depth = true.in_image(self.points, INTRINSICS)
        found = Model(camera, np.eye(4), 1.0, scale, offset).in_base(pixels, self.errors.depth(depth), self.intrinsics)
        return float(np.sqrt(((found - self.points) ** 2).sum(1).mean()))


def case(seed: int, errors: Errors | None = None, count: int = 25, **poses: float) -> Case:
    """A station by seed. ``poses`` goes to :func:`propose`."""
    errors = errors or Errors()
    rng = generator("benchmarks/calibration", seed)
    board, camera = Board(), _camera()
    intrinsics = INTRINSICS.copy()
    intrinsics[[0, 1], [0, 1]] *= 1 + rng.normal() * errors.focal
    intrinsics[:2, 2] += rng.normal(size=2) * errors.centre
    middle = board.corners().mean(0)
    mount = _pose(rng.normal(size=3) * 0.04, [0.002, -0.13, 0.02])  # of the board's middle at the flange
    facing = camera.copy()
    facing[:3, 3] = PLACE + [0, 0, ABOVE]
    nominal = mount[:3, 3] + rng.normal(size=3) * 0.01
    views, boards = [], []
    for flange in propose(facing @ np.linalg.inv(mount), nominal, count, seed=seed, **poses):
        boards.append(np.linalg.inv(camera) @ flange @ mount @ _pose(np.zeros(3), -middle))
        corners = errors.square * (board.corners() - middle) + middle
        seen = corners @ boards[-1][:3, :3].T + boards[-1][:3, 3]
        pixels = ((seen / seen[:, 2:]) @ INTRINSICS.T)[:, :2] + rng.normal(size=(len(corners), 2)) * errors.pixel
        depth = errors.depth(seen[:, 2]) + rng.normal() * errors.shared
        disparity = INTRINSICS[0, 0] * BASELINE / depth + rng.normal(size=len(corners)) * errors.disparity
        told = flange @ _pose(rng.normal(size=3) * errors.rotation, rng.normal(size=3) * errors.position)
        views.append(View(told, np.arange(len(corners)), pixels, INTRINSICS[0, 0] * BASELINE / disparity))
    return Case(errors, board, views, intrinsics, bin_points(_pose(np.zeros(3), PLACE), BIN), camera, boards)


def closed_form(case: Case) -> tuple[float, float]:
    """Hand-eye calibration from the poses of flange and board."""
    return case.error(_start(case)[0].camera), np.nan


def scaled(case: Case) -> tuple[float, float]:
    """The same, and the depth's scale."""
    model, scale = _start(case)
    return case.error(model.camera, scale), np.nan


def bundle(case: Case, noise: Noise) -> tuple[float, float]:
    """A bundle adjustment."""
    model = fit(measurements(case.views, case.intrinsics, case.board), _start(case)[0], noise).model
    return case.error(model.camera, model.scale, model.offset), np.nan


def ours(case: Case) -> tuple[float, float]:
    """What the command does."""
    result = calibrate(case.views, case.intrinsics, case.board, case.points)
    return case.error(result.camera, result.depth_scale, result.depth_offset), result.error


EXACT, NO_OFFSET = {"position": 1e-9, "rotation": 1e-9}, {"offset": 1e-9}
METHODS: dict[str, Callable[[Case], tuple[float, float]]] = {
    "closed form": closed_form,
    "closed form, depth's scale": scaled,
    "bundle, scale": lambda case: bundle(case, Noise(**EXACT, **NO_OFFSET)),
    "bundle, scale, pose errors": lambda case: bundle(case, Noise(**NO_OFFSET)),
    "bundle, scale, offset, pose errors: ours": ours,
}
CASES: dict[str, dict[str, Any]] = {
    "15 views": {"count": 15},
    "50 views": {"count": 50},
    "tilt up to 20 degrees": {"tilt": np.radians(20)},
    "within 5 cm": {"radius": 0.05},
    "poses 3 times worse": {"errors": Errors(position=9e-4, rotation=15e-4)},
    "corners 3 times worse": {"errors": Errors(pixel=0.6)},
    "depth of a view 1 mm off": {"errors": Errors(shared=0.001)},
    "intrinsics 5 times worse": {"errors": Errors(focal=0.01, centre=5.0)},
    "exact intrinsics": {"errors": Errors(focal=0.0, centre=0.0)},
    "depth 2 mm too far": {"errors": Errors(offset=0.002)},
    "depth bent by 5 mm at 1 m": {"errors": Errors(bend=0.005)},
    "squares of 20.1 mm": {"errors": Errors(square=1.005)},
}


def measure(row: str, seed: int) -> dict[str, Any]:
    """One calibration."""
    station = case(seed, **CASES.get(row, {}))
    begin = process_time()
    error, predicted = METHODS.get(row, ours)(station)
    return {"error": error, "predicted": predicted, "seconds": process_time() - begin}


def summary(row: str, results: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of the table."""
    error, predicted, seconds = (np.array([result[key] for result in results]) for key in ("error", "predicted", "seconds"))
    ratio = error / predicted
    return {
        "way or station": row,
        "error": 1000 * _rms(error),
        "worst": 1000 * error.max(),
        "predicted": 1000 * _rms(predicted),
        "within twice": float(((ratio > 0.5) & (ratio < 2)).mean()),
        "worst / predicted": ratio.max(),
        "seconds": float(np.median(seconds)),
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    parser.add_argument("--workers", type=at_least_one, default=2, metavar="N", help="processes (default 2)")
    parser.add_argument("--seeds", type=at_least_one, default=30, metavar="N", help="stations a row (default 30)")
    args = parser.parse_args()
    rows = [*METHODS, *CASES]
    results = list(spread(measure, [(row, seed) for row in rows for seed in range(args.seeds)], args.workers, "calibration"))
    table = [summary(row, results[i * args.seeds : (i + 1) * args.seeds]) for i, row in enumerate(rows)]
    finish("Calibration: millimetres", table, args.json)


def _start(case: Case) -> tuple[Model, float]:
    corners = case.board.corners()
    poses = [board_pose(corners[view.ids], view.pixels, case.intrinsics)[0] for view in case.views]
    model = start(np.array([view.flange for view in case.views]), np.array(poses))
    m = measurements(case.views, case.intrinsics, case.board)
    return model, float(np.median(m.in_camera(model)[:, 2] / m.depth))


def _camera() -> np.ndarray:
    """0.5 m to the side of the bin's middle and 0.6 m above, looking at it."""
    away = np.array([0.5, 0.0, 0.6])
    forward = -away / np.linalg.norm(away)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, np.cross(forward, right), forward]), PLACE + away
    return pose


def _pose(turn: np.ndarray, place: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return pose


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


if __name__ == "__main__":
    main()
