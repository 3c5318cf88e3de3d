"""An oracle that plans picks from the true poses and meshes of the objects. It shows how well a policy could do.

The oracle casts rays at the collision meshes. It never tries a pick in the simulator. Its picks are executed like any other
pick, at the height that the camera sensed at the chosen pixel.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from see2act.robot.gripper import Gripper
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.suction import SuctionCup
from see2act.robot.types import RobotError

HOPELESS = -1000.0
"""Logit of a pick that the oracle rules out."""
UNCHECKED = -200.0
"""Logit of picks on an object that were not checked in detail."""


def oracle(robot: SimulatedRobot, angles: int) -> Callable[[np.ndarray, np.ndarray], Float[np.ndarray, "A H W"]]:
    """An oracle for the tool of ``robot``: a function from (color, height) of an observation to logits of every pick.

    Raises:
        RobotError: No oracle exists for this end effector.
    """
    if isinstance(robot.tool, SuctionCup):
        return _SuctionOracle(robot, robot.tool)
    if isinstance(robot.tool, Gripper):
        return _GraspOracle(robot, robot.tool, angles)
    raise RobotError(f"there is no oracle for {type(robot.tool).__name__}: write one beside those in robot/oracle.py")


class ExactHeights:
    """The exact height and body id of each workspace cell, seen from straight above."""

    def __init__(self, robot: SimulatedRobot):
        rows, cols = np.indices(robot.workspace.shape)
        x, y = robot.workspace.to_world(rows.ravel(), cols.ravel())
        above = np.column_stack([x, y, np.full(x.shape, 0.3)])
        hits = robot.simulation.cast(above, above - [0, 0, 0.31])
        self.height: Float[np.ndarray, "H W"] = hits.position[:, 2].reshape(rows.shape)
        self.body: Int[np.ndarray, "H W"] = hits.body.reshape(rows.shape)
        self.points = np.stack([x, y, hits.position[:, 2]], axis=-1).reshape(*rows.shape, 3)


class _SuctionOracle:
    """Prefers pixels where the whole rim is on one flat face, near the middle of an object with little on top of it."""

    def __init__(self, robot: SimulatedRobot, cup: SuctionCup):
        self._robot, self._cup = robot, cup

    def __call__(self, color: np.ndarray, height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "1 H W"]:
        robot, cup = self._robot, self._cup
        top, centres = ExactHeights(robot), robot.scene.positions()
        logits = np.full(height.shape, HOPELESS)
        # If the sensed height is too low, force stops the descent. If it is too high, the cup does not reach the object.
        cells = np.isin(top.body, list(centres)) & (height - top.height < 0.8 * cup.press)
        points, bodies, off_height = top.points[cells], top.body[cells], np.abs(height - top.height)[cells]
        if not len(points):
            return logits[None]
        turns = np.arange(16) * np.pi / 8
        rim = (cup.cup_radius + 0.0005) * np.column_stack([np.cos(turns), np.sin(turns), np.zeros(16)])
        above = points[:, None] * [1, 1, 0] + rim + [0, 0, 0.3]
        hits = robot.simulation.cast(above.reshape(-1, 3), above.reshape(-1, 3) - [0, 0, 0.31])
        on_one = (hits.body.reshape(-1, 16) == bodies[:, None]).all(1)
        lip = hits.position.reshape(-1, 16, 3)
        off_plane, tilt = _plane(lip)
        good = on_one & (off_plane < 0.8 * cup.flatness) & (tilt < 0.9 * cup.tilt)
        at = np.array([centres[body] for body in bodies])
        lever = np.linalg.norm(points[:, :2] - at[:, :2], axis=1)
        burden = _burdens(robot)
        load = np.array([burden[body] for body in bodies])
        # Everything is weighed in metres of lever: 20 degrees of tilt, or one object on top, count as much as 2 cm.
        score = 5 - 100 * (lever + 0.02 * tilt / np.radians(20) + 0.02 * load + off_height)
        # If no pixel suits the cup, it presses on the flattest one, so that a leaning object there may fall over.
        logits[cells] = np.where(good, score, -10 - tilt - 1000 * off_plane)
        return logits[None]


class _GraspOracle:
    """Prefers grasps whose open fingers have room beside an object, and whose pads close on two opposite faces of it only.

    If no grasp meets all of these conditions, the one with the fewest faults wins.
    """

    COARSE, FINE = 1000, 60
    """Picks per object, out of all its cells and angles, that are checked for room, and then for how the pads would close."""
    LATERAL = np.array([-0.008, 0.0, 0.008])
    """Offsets of the rays across the width of the pads (22 mm), metres from their middle."""
    LEVELS = np.array([-0.012, -0.004, 0.004, 0.012])
    """Offsets of the rays along the height of the pads (37 mm), metres from their middle."""

    def __init__(self, robot: SimulatedRobot, gripper: Gripper, angles: int):
        self._robot, self._gripper = robot, gripper
        self._angles = np.arange(angles) * np.pi / angles
        self._underside: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, color: np.ndarray, height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "A H W"]:
        robot, centres = self._robot, self._robot.scene.positions()
        if self._underside is None:
            self._underside = _underside(robot)
        top, burdens = ExactHeights(robot), _burdens(robot)
        logits = np.full((len(self._angles), *height.shape), HOPELESS)
        for body, centre in centres.items():
            rows, cols = np.nonzero(top.body == body)
            if not len(rows):
                continue
            # All picks on this object as flat arrays of length cells x angles.
            angle = np.tile(np.arange(len(self._angles)), len(rows))
            rows, cols = (np.repeat(i, len(self._angles)) for i in (rows, cols))
            jaw = np.column_stack([np.cos(self._angles), np.sin(self._angles), np.zeros(len(self._angles))])[angle]
            points = top.points[rows, cols] * [1, 1, 0]
            points[:, 2] = self._gripper.depth_at(height[rows, cols].astype(float))
            across = np.abs(np.cross(jaw, points - centre)[:, 2])
            along = np.abs(((points - centre) * jaw).sum(1))
            coarse = -100 * across - 40 * along - 2 * burdens[body]
            logits[angle, rows, cols] = UNCHECKED + coarse  # used if every checked pick fails
            best = np.argsort(coarse, kind="stable")[-self.COARSE :]
            overlap = self._overlap(top, points[best], jaw[best])
            roomy = np.argsort(coarse[best] - 1000 * overlap, kind="stable")[-self.FINE :]
            best, overlap = best[roomy], overlap[roomy]
            score = 5 + coarse[best] + self._closing(points[best], body, jaw[best]) - 4 * (overlap > 0) - 300 * overlap
            logits[angle[best], rows[best], cols[best]] = score
        return logits

    def _overlap(self, top: ExactHeights, points: np.ndarray, jaw: np.ndarray) -> Float[np.ndarray, " n"]:
        """Metres by which the open gripper would penetrate something on its way straight down to ``points``."""
        assert self._underside is not None
        offsets, under = self._underside
        across = np.cross([0, 0, 1], jaw)
        at = points[:, None] + offsets[:, :1] * jaw[:, None] + offsets[:, 1:] * across[:, None]
        rows, cols = self._robot.workspace.to_pixel(at[..., 0], at[..., 1])
        h, w = top.height.shape
        inside = (rows >= 0) & (rows < h) & (cols >= 0) & (cols < w)
        scene = np.where(inside, top.height[rows.clip(0, h - 1), cols.clip(0, w - 1)], self._robot.scene.wall_height)
        return (scene - points[:, 2:] - under + 0.001).max(1).clip(0)

    def _closing(self, points: np.ndarray, body: int, jaw: np.ndarray) -> Float[np.ndarray, " n"]:
        """A score for how well the closing pads would hold: lower for each fault."""
        n, across = len(points), np.cross([0, 0, 1], jaw)
        grid = self.LATERAL[None, :, None, None] * across[:, None, None] + self.LEVELS[:, None] * np.array([0, 0, 1])
        grid = grid.reshape(n, -1, 3)
        width = np.full(n, 0.05)
        for _ in range(2):  # the pads swing down as they close; how far depends on the width of the object
            at = points[:, None] + grid - self._gripper.swing(width)[:, None, None] * [0, 0, 1]
            sides = [self._side(at, body, sign * jaw) for sign in (-1, 1)]
            reach = np.array([side[0].max(1) for side in sides])
            width = np.where(np.isfinite(reach.sum(0)), reach.sum(0), 0.05).clip(0, self._gripper.opening(0.0))
        touch = [side[0] > most[:, None] - 0.0015 for side, most in zip(sides, reach, strict=True)]
        both = (touch[0] & touch[1]).sum(1)
        steep = np.degrees(
            np.arccos(np.minimum(*(np.where(t, s[1], 1).min(1) for t, s in zip(touch, sides, strict=True))).clip(0, 1))
        )
        alone = sides[0][2] & sides[1][2]
        graspable = np.isfinite(reach).all(0) & (width > self._gripper.threshold + 0.003)
        off_centre = np.abs(np.subtract(*np.where(graspable, reach, 0))) / 2
        score = 0.2 * both - 40 * off_centre - 3 * (both < 2) - 0.3 * (steep - 10).clip(0) - 4 * ~alone
        return np.where(graspable, score, -20)

    def _side(self, at: np.ndarray, body: int, inward: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What one pad meets while it closes.

        Returns:
            For each ray, the distance from the middle at which it meets the body in metres (minus infinity if it does not),
            and the cosine of the angle between the face there and the pad. For each pick, whether the pad meets no other
            object.
        """
        n, rays, _ = at.shape
        half = 0.49 * self._gripper.opening(0.0) * inward[:, None]
        hits = self._robot.simulation.cast((at - half).reshape(-1, 3), (at + half).reshape(-1, 3))
        met, on = hits.body.reshape(n, rays), hits.body.reshape(n, rays) == body
        reach = np.where(on, -((hits.position.reshape(n, rays, 3) - at) * inward[:, None]).sum(-1), -np.inf)
        facing = -(hits.normal.reshape(n, rays, 3) * inward[:, None]).sum(-1)
        return reach, facing, (on | (met == -1) | (met == self._robot.scene.floor)).all(1)


def _plane(points: Float[np.ndarray, "n k 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Largest distance in metres of each set of points from its best-fit plane, and the tilt of the plane in radians."""
    centred = points - points.mean(1, keepdims=True)
    normal = np.linalg.svd(centred, full_matrices=False)[2][:, 2]
    off = np.abs(np.einsum("nkd,nd->nk", centred, normal)).max(1)
    return off, np.arccos(np.abs(normal[:, 2]).clip(0, 1))


def _burdens(robot: SimulatedRobot) -> dict[int, int]:
    """Number of objects that lie on each object, by body id."""
    at = robot.scene.positions()
    burdens = dict.fromkeys(at, 0)
    for body in at:
        touching = {point[2] for point in robot.simulation.client.getContactPoints(body)} & set(at)
        burdens[body] = sum(at[other][2] > at[body][2] + 0.005 for other in touching)
    return burdens


def _underside(robot: SimulatedRobot) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """The underside of the open gripper, measured at home.

    Returns:
        Offsets along and across the jaws in metres, and heights above the middle of the pads in metres.
    """
    along, across = np.meshgrid(np.arange(-0.1, 0.1001, 0.004), np.arange(-0.02, 0.0201, 0.004), indexing="ij")
    centre = robot.arm.tool_position() - [0, 0, robot.tool.length()]
    jaw = robot.arm.tool_rotation()[:, 0]
    side = np.cross([0, 0, 1], jaw)
    start = centre + along.reshape(-1, 1) * jaw + across.reshape(-1, 1) * side - [0, 0, 0.05]
    hits = robot.simulation.cast(start, start + [0, 0, 0.15])
    on = hits.body == robot.arm.body
    offsets = np.column_stack([along.ravel(), across.ravel()])[on]
    return offsets, hits.position[on, 2] - centre[2]
