"""Whether the arm goes where it is told, and what it touches: inverse kinematics over the workspace, picks at the walls."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from benchmarks.common import PRIMITIVES, arguments, at_least_one, finish, parsed, spread
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.robot.arm import JOINTS, pointing_down
from see2act.robot.simulated import LIFT, SimulatedRobot
from see2act.robot.types import Pick
from see2act.seeding import generator, seed_for

ANGLES = 16
TARGETS = {"position": 0.0005, "rotation": 0.2, "limit": 0.2, "penetration": 0.002}
"""Metres, degrees, radians left to a joint's limit (at least), metres."""


def reach(overrides: list[str], primitive: str, stride: int) -> list[dict[str, Any]]:
    """Kinematics at every ``stride``-th pixel, the outermost included, at all angles, from floor to lift."""
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    robot.simulation.clear()
    robot.arm.load()
    tool, (rows, cols) = robot.tool, robot.workspace.shape
    low = float(tool.depth_at(np.array(0.0))) + tool.length()
    high = cfg.robot.clearance + tool.length() + LIFT
    poses = failures = 0
    position = rotation = 0.0
    spare = np.inf
    client, body = robot.simulation.client, robot.arm.body
    limits = np.array([client.getJointInfo(body, robot.arm.joint_index[name])[8:10] for name in JOINTS])
    for row in sorted({*range(0, rows, stride), rows - 1}):
        for col in sorted({*range(0, cols, stride), cols - 1}):
            for z in np.linspace(low, high, 4):
                for angle in np.arange(ANGLES) * np.pi / ANGLES:
                    poses += 1
                    at = np.array([*robot.workspace.to_world(row, col), z])
                    joints = robot.arm.solve(at, angle)
                    if joints is None:
                        failures += 1
                        continue
                    robot.arm.teleport(joints)
                    position = max(position, float(np.linalg.norm(robot.arm.tool_position() - at)))
                    rotation = max(rotation, _turned(robot.arm.tool_rotation(), angle))
                    spare = min(spare, float((joints - limits[:, 0]).min()), float((limits[:, 1] - joints).min()))
    robot.close()
    return [
        _row(f"{primitive}: poses without a solution", failures, poses, 0),
        _row(f"{primitive}: error of position, m", position, poses, TARGETS["position"]),
        _row(f"{primitive}: error of rotation, degrees", rotation, poses, TARGETS["rotation"]),
        _row(f"{primitive}: radians left to a joint's limit, at least", spare, poses, TARGETS["limit"], most=False),
    ]


def _turned(rotation: np.ndarray, angle: float) -> float:
    """Degrees between a tool's rotation and the wanted one; a tool is the same after half a turn."""
    half_turn = np.diag([-1.0, -1.0, 1.0])
    between = [rotation.T @ pointing_down(angle) @ turn for turn in (np.eye(3), half_turn)]
    return min(float(np.degrees(np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)))) for r in between)


class Touch:
    """A spectator of a robot: the worst of what its links do to bin and table."""

    def __init__(self, robot: SimulatedRobot):
        self._robot = robot
        self._links = {robot.arm.joint_index[name] for name in JOINTS}  # a link's index is its joint's
        self.arm_contacts = 0
        self.penetration = 0.0
        self.wall_force = 0.0

    def __call__(self) -> None:
        robot = self._robot
        fixed = {robot.scene.table, robot.scene.floor, *robot.scene.walls}
        for point in robot.simulation.client.getContactPoints(bodyA=robot.arm.body):
            _, _, other, link, _, _, _, _, distance, force, *_ = point
            if other not in fixed:
                continue
            if link in self._links and distance < 0:
                self.arm_contacts += 1
            if other in robot.scene.walls:
                self.wall_force = max(self.wall_force, force)
                self.penetration = max(self.penetration, -distance)


def walls(overrides: list[str], primitive: str, picks: int) -> list[dict[str, Any]]:
    """Picks on the floor along the walls, in the corners and anywhere, at all angles, among objects."""
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    rng = generator(f"benchmarks/arm/{primitive}")
    rows, cols = robot.workspace.shape
    causes: Counter[str] = Counter()
    arm_contacts = wrong = 0
    penetration = 0.0
    for i in range(picks):
        if i % 10 == 0:
            robot.reset(seed_for("scene/arm", i), "seen")
            heightmap = robot.observe().heightmap
        row, col = int(rng.integers(rows)), int(rng.integers(cols))
        if i % 3 < 2:  # at a wall; in a corner
            row = int(rng.choice([0, 1, 3, rows - 4, rows - 2, rows - 1]))
        if i % 3 == 1:
            col = int(rng.choice([0, 1, 3, cols - 4, cols - 2, cols - 1]))
        angle = float(rng.integers(cfg.primitive.angles) * np.pi / cfg.primitive.angles)
        touch = robot.simulation.after_step = Touch(robot)
        outcome = robot.execute(robot.workspace.pick(heightmap, row, col, angle))
        robot.simulation.after_step = None
        causes[outcome.cause] += 1
        arm_contacts += touch.arm_contacts
        penetration = max(penetration, touch.penetration)
        wrong += outcome.cause == "wall" and (outcome.success or touch.wall_force == 0)
    far = robot.execute(Pick(0, 0, 0.0, 2.0, 0.0, 0.0))
    robot.close()
    print(f"{primitive}: causes of {picks} picks: {dict(causes)}")
    return [
        _row(f"{primitive}: contacts of the arm's links with bin or table", arm_contacts, picks, 0),
        _row(f"{primitive}: penetration of a wall, m", penetration, picks, TARGETS["penetration"]),
        _row(f"{primitive}: picks stopped by a wall", causes["wall"], picks, picks // 20, most=False),
        _row(f"{primitive}: picks called `wall` that met none, or succeeded", wrong, picks, 0),
        _row(f"{primitive}: unreachable picks not called so", int(far.cause != "unreachable" or far.success), 1, 0),
    ]


def _row(name: str, worst: float, of: int, target: float, most: bool = True) -> dict[str, Any]:
    return {"name": name, "worst": worst, "of": of, "target": target, "met": worst <= target if most else worst >= target}


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--stride", type=at_least_one, default=4, metavar="N", help="pixels between poses (default 4)")
    parser.add_argument("--picks", type=at_least_one, default=300, metavar="N", help="a primitive (default 300)")
    args = parsed(parser)
    parts = list(spread(reach, [(args.overrides, p, args.stride) for p in PRIMITIVES], args.workers, "reach"))
    parts += spread(walls, [(args.overrides, p, args.picks) for p in PRIMITIVES], args.workers, "walls")
    finish("The arm", [row for part in parts for row in part], args.json)


if __name__ == "__main__":
    main()
