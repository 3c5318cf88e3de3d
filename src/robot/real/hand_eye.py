"""The arithmetic of the calibration: where the camera is, from images of a board that the flange carries through many poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

ROUNDS = 20
"""Rounds of reweighting in :func:`start`. It has settled after ten."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations that weigh the measurements against each other. The error of the result does not rest on them."""

    pixel: float = 0.2
    """Of a corner, pixels. Rendered boards with blur and noise: 0.1 when flat, 0.2 when tilted by 45 degrees."""
    depth: float = 0.0016
    """Of a depth reading, metres at one metre; it grows with the square. A RealSense D415: 0.08 pixels of disparity (Intel's
    tuning guide) over 930 pixels of focal length and 55 mm of baseline."""
    position: float = 3e-4
    rotation: float = 5e-4
    """Of the flange's pose as the controller reports it, metres and radians. Assumed for a UR5 with its factory calibration,
    which repeats to 0.1 mm."""
    offset: float = 0.005
    """Of the depth's offset around zero, metres: it keeps offset and scale apart where all views are equally far."""
    square: float = 0.02
    """Of the squares' size around the stated one, as a share: it counts only where the board hardly moves."""


@dataclass(frozen=True)
class Model:
    """What is looked for."""

    camera: Float[np.ndarray, "4 4"]
    """Camera to base, metres."""
    board: Float[np.ndarray, "4 4"]
    """Board to flange, metres."""
    square: float = 1.0
    """True size of the squares as a share of the stated one."""
    scale: float = 1.0
    offset: float = 0.0
    """True depth is scale times measured depth plus offset, metres."""

    def moved(self, step: Float[np.ndarray, "15"]) -> Model:
        """This model after a small step: rotation vector and translation of the camera, the same of the board, and the
        three numbers."""
        numbers = self.square + step[12], self.scale + step[13], self.offset + step[14]
        return Model(self.camera @ _rigid(step[:6]), self.board @ _rigid(step[6:12]), *map(float, numbers))

    def in_base(
        self, pixels: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, " n"], intrinsics: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Where pixels with these measured depths are, metres in the frame of the base."""
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsics).T
        return (rays * (self.scale * depth + self.offset)[:, None]) @ self.camera[:3, :3].T + self.camera[:3, 3]

    def in_image(
        self, points: Float[np.ndarray, "n 3"], intrinsics: Float[np.ndarray, "3 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Pixels and measured depths of points in the frame of the base: the reverse of :meth:`in_base`."""
        camera = (points - self.camera[:3, 3]) @ self.camera[:3, :3]
        pixels = (camera / camera[:, 2:]) @ intrinsics.T
        return pixels[:, :2], (camera[:, 2] - self.offset) / self.scale


@dataclass(frozen=True)
class Measurements:
    """All views in one: n corners in v views."""

    flanges: Float[np.ndarray, "v 4 4"]
    """Flange to base, metres, as the controller reports it."""
    view: Int[np.ndarray, " n"]
    """Of which view a corner is; ascending."""
    corners: Float[np.ndarray, "n 3"]
    """In the board's frame, metres."""
    pixels: Float[np.ndarray, "n 2"]
    depth: Float[np.ndarray, " n"]
    """As measured, metres; 0 where there is none."""
    intrinsics: Float[np.ndarray, "3 3"]

    def errors(self, model: Model) -> Float[np.ndarray, "n 3"]:
        """How far the model is off at each corner: two of the pixel, and metres of measured depth where there is one."""
        camera = self.in_camera(model)
        pixels = (camera / camera[:, 2:]) @ self.intrinsics.T
        return np.column_stack([pixels[:, :2] - self.pixels, (camera[:, 2] - model.offset) / model.scale - self.depth])

    def in_camera(self, model: Model) -> Float[np.ndarray, "n 3"]:
        """The corners in the camera's frame, metres."""
        base = np.einsum("nij,nj->ni", self.flanges[self.view, :3, :3], self.in_flange(model))
        return (base + self.flanges[self.view, :3, 3] - model.camera[:3, 3]) @ model.camera[:3, :3]

    def in_flange(self, model: Model) -> Float[np.ndarray, "n 3"]:
        """The corners in the flange's frame, metres."""
        return model.square * self.corners @ model.board[:3, :3].T + model.board[:3, 3]


@dataclass(frozen=True)
class Fit:
    """A model, and how the measurements hold it."""

    model: Model
    measurements: Measurements
    jacobian: Float[np.ndarray, "m 15"]
    """Of the weighted errors, for the steps of :meth:`Model.moved`."""
    errors: Float[np.ndarray, " m"]
    rows: list[slice]
    """Of each view in the weighted errors. The last two rows are those of the offset and of the square."""
    weights: list[Float[np.ndarray, "k k"]]
    noise: Noise

    def steps_for(
        self, intrinsics: Sequence[Float[np.ndarray, "3 3"]]
    ) -> tuple[Float[np.ndarray, "k 15"], Float[np.ndarray, " k"]]:
        """The steps from this model to those of other intrinsics, and how much of each change the measurements ask for, if
        the size of the change is its standard deviation."""
        others = [replace(self.measurements, intrinsics=other) for other in intrinsics]
        changes = np.column_stack([_weighted(m, self.model, self.weights, self.noise) - self.errors for m in others])
        steps = -np.linalg.lstsq(self.jacobian, changes, rcond=None)[0]
        unexplained = changes + self.jacobian @ steps
        shares = -np.linalg.solve(unexplained.T @ unexplained + np.eye(len(others)), unexplained.T @ self.errors)
        return steps.T, shares

    def step_without(self, view: int) -> Float[np.ndarray, "15"]:
        """The step from this model to that of all views but one."""
        jacobian, errors = (np.delete(array, self.rows[view], axis=0) for array in (self.jacobian, self.errors))
        return -np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ errors)

    def steps_for_priors(self) -> Float[np.ndarray, "2 15"]:
        """The steps that an offset and a square make that are one standard deviation from what was assumed."""
        return np.linalg.solve(self.jacobian.T @ self.jacobian, self.jacobian[-2:].T).T

    def deviations(self) -> Float[np.ndarray, "15"]:
        """Standard deviations of the steps, if the noise is as assumed."""
        return np.sqrt(np.diag(np.linalg.inv(self.jacobian.T @ self.jacobian)))


def board_pose(
    corners: Float[np.ndarray, "k 3"], pixels: Float[np.ndarray, "k 2"], intrinsics: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Pose of a board in the camera's frame from one image, and how far its corners are off, pixels rms."""
    _, turn, place = cv2.solvePnP(corners, pixels, intrinsics, None, flags=cv2.SOLVEPNP_IPPE)
    turn, place = cv2.solvePnPRefineLM(corners, pixels, intrinsics, None, turn, place)
    projected, _ = cv2.projectPoints(corners, turn, place, intrinsics, None)
    off = np.sqrt(((projected[:, 0] - pixels) ** 2).sum(1).mean())
    return _rigid(np.concatenate([turn.ravel(), place.ravel()])), float(off)


def start(flanges: Float[np.ndarray, "v 4 4"], boards: Float[np.ndarray, "v 4 4"]) -> Model:
    """A model from the poses of the flange in the base's frame and of the board in the camera's, without a first guess.

    The relative motions of flange and board have the same rotation, seen from base and camera: their rotation vectors give
    the camera's rotation (Park and Martin 1994). All else is linear in the positions. Errors count by their size and not its
    square, so some views may be wrong. The depth is left as measured.
    """
    first, second = np.triu_indices(len(flanges), 1)
    by_flange, by_board = (
        Rotation.from_matrix(poses[second, :3, :3] @ poses[first, :3, :3].transpose(0, 2, 1)).as_rotvec()
        for poses in (flanges, boards)
    )
    weights = np.ones(len(first))
    for _ in range(ROUNDS):
        camera = _nearest_rotation((weights[:, None] * by_flange).T @ by_board)
        weights = 1 / np.maximum(np.linalg.norm(by_flange - by_board @ camera.T, axis=1), 0.01)
    turned = flanges[:, :3, :3].transpose(0, 2, 1) @ camera @ boards[:, :3, :3]
    weights = np.ones(len(flanges))
    for _ in range(ROUNDS):
        board = _nearest_rotation((weights[:, None, None] * turned).sum(0))
        weights = 1 / np.maximum(np.linalg.norm(turned - board, axis=(1, 2)), 0.01)
    # Flange rotation times board's place, minus the camera's place, minus square times the turned place in the camera.
    left = np.concatenate(
        [flanges[:, :3, :3], np.broadcast_to(-np.eye(3), turned.shape), -(boards[:, :3, 3] @ camera.T)[:, :, None]], axis=2
    )
    weights = np.ones(len(flanges))
    for _ in range(ROUNDS):
        w = np.sqrt(weights)[:, None]
        places = np.linalg.lstsq((left * w[..., None]).reshape(-1, 7), (-flanges[:, :3, 3] * w).ravel(), rcond=None)[0]
        weights = 1 / np.maximum(np.linalg.norm(left @ places + flanges[:, :3, 3], axis=1), 0.001)
    return Model(_pose(camera, places[3:6]), _pose(board, places[:3]), float(places[6]))


def fit(measurements: Measurements, guess: Model, noise: Noise | None = None) -> Fit:
    """The most likely model: a bundle adjustment of pixels and depths.

    The errors of the flange's poses are not parameters. They are noise that all corners of a view share.
    """
    noise = noise or Noise()
    model = guess
    for _ in range(2):  # the weights are those of the guess at first
        weights = _weights(measurements, model, noise)
        origin = model
        solution = least_squares(
            lambda step, origin=origin, weights=weights: _weighted(measurements, origin.moved(step), weights, noise),
            np.zeros(15),
            x_scale="jac",
        )
        model = origin.moved(solution.x)
    ends = np.cumsum([0, *map(len, weights)]).tolist()
    rows = [slice(*pair) for pair in pairwise(ends)]
    return Fit(model, measurements, solution.jac, solution.fun, rows, weights, noise)


def _weighted(m: Measurements, model: Model, weights: list[np.ndarray], noise: Noise) -> np.ndarray:
    errors = m.errors(model)
    parts = [weight @ errors[rows].ravel()[_measured(m.depth[rows])] for weight, rows in zip(weights, _rows(m), strict=True)]
    return np.concatenate([*parts, [model.offset / noise.offset, (model.square - 1) / noise.square]])


def _weights(m: Measurements, model: Model, noise: Noise) -> list[np.ndarray]:
    """For each view a matrix that makes its errors independent, with a deviation of 1."""
    focal = m.intrinsics[:2, :2]
    flange, camera = m.in_flange(model), m.in_camera(model)
    weights = []
    for rows, pose in zip(_rows(m), m.flanges, strict=True):
        (x, y, z), k = camera[rows].T, rows.stop - rows.start
        # How the errors change with the corner in the camera, and that with the pose of the flange.
        change = np.zeros((k, 3, 3))
        change[:, :2, :2] = focal / z[:, None, None]
        change[:, :2, 2] = -np.column_stack([x, y]) @ focal.T / z[:, None] ** 2
        change[:, 2, 2] = 1 / model.scale
        turned = np.cross(np.eye(3)[None], flange[rows][:, None]).transpose(0, 2, 1) * noise.rotation
        moved = np.concatenate([turned, np.broadcast_to(np.eye(3) * noise.position, turned.shape)], axis=2)
        shared = (change @ (model.camera[:3, :3].T @ pose[:3, :3]) @ moved).reshape(-1, 6)
        own = np.column_stack([np.full((k, 2), noise.pixel), noise.depth * z**2 / model.scale]).ravel()
        covariance = (np.diag(own**2) + shared @ shared.T)[np.ix_(*2 * [_measured(m.depth[rows])])]
        weights.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return weights


def _rows(m: Measurements) -> list[slice]:
    ends = np.searchsorted(m.view, np.arange(len(m.flanges) + 1)).tolist()
    return [slice(*pair) for pair in pairwise(ends)]


def _measured(depth: np.ndarray) -> np.ndarray:
    """Which of the errors of corners, flat, are there."""
    return np.column_stack([np.ones((len(depth), 2), bool), depth > 0]).ravel()


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    u, _, v = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v


def _rigid(step: np.ndarray) -> np.ndarray:
    return _pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6])


def _pose(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose
