"""Where a pick would succeed, planned from the objects' poses and meshes: what is possible, beside what was learned.

The oracle casts rays at the collision meshes where they lie. It never tries a pick in the simulator, and what it
chooses is executed as any other pixel is: at the height that the camera sensed there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from see2act.robot.gripper import Gripper
from see2act.robot.robot import SimulatedRobot
from see2act.robot.suction import SuctionCup
from see2act.robot.types import RobotError

HOPELESS = -1000.0
"""Logit of a pick that the oracle rules out."""
UNCHECKED = -200.0
"""Of picks on an object that were not looked at closely."""


def oracle(robot: SimulatedRobot, angles: int) -> Callable[[np.ndarray, np.ndarray], Float[np.ndarray, "A H W"]]:
    """How well each pick of ``robot``'s tool would go: (color, height) of an observation to logits of ``angles`` x pixels.

    Raises:
        RobotError: There is no oracle for this end effector.
    """
    if isinstance(robot.tool, SuctionCup):
        return _SuctionOracle(robot, robot.tool)
    if isinstance(robot.tool, Gripper):
        return _GraspOracle(robot, robot.tool, angles)
    raise RobotError(f"there is no oracle for {type(robot.tool).__name__}: write one beside those in robot/oracle.py")


class ExactHeights:
    """The scene from straight above, exactly: height and body of each cell of the workspace."""

    def __init__(self, robot: SimulatedRobot):
        rows, cols = np.indices(robot.workspace.shape)
        x, y = robot.workspace.to_world(rows.ravel(), cols.ravel())
        above = np.column_stack([x, y, np.full(x.shape, 0.3)])
        hits = robot.simulation.cast(above, above - [0, 0, 0.31])
        self.height: Float[np.ndarray, "H W"] = hits.position[:, 2].reshape(rows.shape)
        self.body: Int[np.ndarray, "H W"] = hits.body.reshape(rows.shape)
        self.points = np.stack([x, y, hits.position[:, 2]], axis=-1).reshape(*rows.shape, 3)


class _SuctionOracle:
    """The cup's whole rim on one flat face, near the middle of an object with little on top of it."""

    def __init__(self, robot: SimulatedRobot, cup: SuctionCup):
        self._robot, self._cup = robot, cup

    def __call__(self, color: np.ndarray, height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "1 H W"]:
        robot, cup = self._robot, self._cup
        top, centres = ExactHeights(robot), robot.scene.positions()
        logits = np.full(height.shape, HOPELESS)
        # A cup sent too deep is stopped by force; one sent too high, for the sensed height is wrong, meets nothing.
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
        # Weights in metres of lever: 20 degrees of tilt, or another object's weight on top, are worth 2 cm.
        score = 5 - 100 * (lever + 0.02 * tilt / np.radians(20) + 0.02 * load + off_height)
        # Where nothing suits the cup, it presses on the flattest place: what leans there may fall over.
        logits[cells] = np.where(good, score, -10 - tilt - 1000 * off_plane)
        return logits[None]


class _GraspOracle:
    """Open fingers that come down beside an object, and pads that close on two opposite faces of it alone.

    Where no pick has all of this, the least bad one wins.
    """

    COARSE, FINE = 1000, 60
    """Picks an object that are checked for room, and for how the pads would close, of all its cells and angles."""
    LATERAL = np.array([-0.008, 0.0, 0.008])
    """Where rays run across the pads (22 mm wide), metres from their middle."""
    LEVELS = np.array([-0.012, -0.004, 0.004, 0.012])
    """The same along the pads (37 mm high)."""

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
            # All picks on this object, (cells x angles) in a row.
            angle = np.tile(np.arange(len(self._angles)), len(rows))
            rows, cols = (np.repeat(i, len(self._angles)) for i in (rows, cols))
            jaw = np.column_stack([np.cos(self._angles), np.sin(self._angles), np.zeros(len(self._angles))])[angle]
            points = top.points[rows, cols] * [1, 1, 0]
            points[:, 2] = self._gripper.depth_at(height[rows, cols].astype(float))
            across = np.abs(np.cross(jaw, points - centre)[:, 2])
            along = np.abs(((points - centre) * jaw).sum(1))
            coarse = -100 * across - 40 * along - 2 * burdens[body]
            logits[angle, rows, cols] = UNCHECKED + coarse  # for when all that is checked has failed
            best = np.argsort(coarse, kind="stable")[-self.COARSE :]
            overlap = self._overlap(top, points[best], jaw[best])
            roomy = np.argsort(coarse[best] - 1000 * overlap, kind="stable")[-self.FINE :]
            best, overlap = best[roomy], overlap[roomy]
            score = 5 + coarse[best] + self._closing(points[best], body, jaw[best]) - 4 * (overlap > 0) - 300 * overlap
            logits[angle[best], rows[best], cols[best]] = score
        return logits

    def _overlap(self, top: ExactHeights, points: np.ndarray, jaw: np.ndarray) -> Float[np.ndarray, " n"]:
        """Metres by which the open gripper, coming straight down to ``points``, would have to go through something."""
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
        """How well closing pads would hold: 0 where all is well, less for each fault."""
        n, across = len(points), np.cross([0, 0, 1], jaw)
        grid = self.LATERAL[None, :, None, None] * across[:, None, None] + self.LEVELS[:, None] * np.array([0, 0, 1])
        grid = grid.reshape(n, -1, 3)
        width = np.full(n, 0.05)
        for _ in range(2):  # the pads swing down as they close, by how much depends on the width that they meet
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
        """What one pad meets on its way in.

        Returns:
            For each ray, metres from the middle at which it meets the body (minus infinity: not at all) and the cosine
            between the face there and the pad; and for each pick, whether the pad meets no other object.
        """
        n, rays, _ = at.shape
        half = 0.49 * self._gripper.opening(0.0) * inward[:, None]
        hits = self._robot.simulation.cast((at - half).reshape(-1, 3), (at + half).reshape(-1, 3))
        met, on = hits.body.reshape(n, rays), hits.body.reshape(n, rays) == body
        reach = np.where(on, -((hits.position.reshape(n, rays, 3) - at) * inward[:, None]).sum(-1), -np.inf)
        facing = -(hits.normal.reshape(n, rays, 3) * inward[:, None]).sum(-1)
        return reach, facing, (on | (met == -1) | (met == self._robot.scene.floor)).all(1)


def _plane(points: Float[np.ndarray, "n k 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Largest distance of each set of points from its plane in metres, and the plane's tilt in radians."""
    centred = points - points.mean(1, keepdims=True)
    normal = np.linalg.svd(centred, full_matrices=False)[2][:, 2]
    off = np.abs(np.einsum("nkd,nd->nk", centred, normal)).max(1)
    return off, np.arccos(np.abs(normal[:, 2]).clip(0, 1))


def _burdens(robot: SimulatedRobot) -> dict[int, int]:
    """How many objects lie on each object, by body id."""
    at = robot.scene.positions()
    burdens = dict.fromkeys(at, 0)
    for body in at:
        touching = {point[2] for point in robot.simulation.client.getContactPoints(body)} & set(at)
        burdens[body] = sum(at[other][2] > at[body][2] + 0.005 for other in touching)
    return burdens


def _underside(robot: SimulatedRobot) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """The open gripper from below, at home: offsets along and across the jaws, and metres above the pads' middle."""
    along, across = np.meshgrid(np.arange(-0.1, 0.1001, 0.004), np.arange(-0.02, 0.0201, 0.004), indexing="ij")
    centre = robot.arm.tool_position() - [0, 0, robot.tool.length()]
    jaw = robot.arm.tool_rotation()[:, 0]
    side = np.cross([0, 0, 1], jaw)
    start = centre + along.reshape(-1, 1) * jaw + across.reshape(-1, 1) * side - [0, 0, 0.05]
    hits = robot.simulation.cast(start, start + [0, 0, 0.15])
    on = hits.body == robot.arm.body
    offsets = np.column_stack([along.ravel(), across.ravel()])[on]
    return offsets, hits.position[on, 2] - centre[2]
