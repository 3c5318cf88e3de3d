"""A UR5 that follows straight Cartesian lines above the bin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from ur_analytic_ik import ur5

from see2act.robot.simulation import TIMESTEP, Simulation, file_of
from see2act.robot.types import RobotError, is_triple

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
EFFORT = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
"""Largest torque of each joint, N m, from the UR5's URDF."""
GAIN = 0.6
"""Share of the joint error that a motor corrects in one step. The tool then tracks within 0.5 mm without ringing."""
KNOTS_APART = 0.01
"""Metres between the points of a straight line where the inverse kinematics is solved. A cubic spline through them deviates
from the line by less than a micrometre."""
HOME_ANGLE = np.pi / 2
"""Radians: the middle of the pick angles [0, pi), so that the last joint never turns by more than a quarter turn."""


@dataclass(frozen=True)
class ArmConfig:
    """Where the arm stands and how fast it moves.

    Args:
        base: World position of the base, metres. Its x axis points at the bin.
        home: World position of ``tool0`` before and after each attempt, metres.
        joint_speed: Speed of the fastest joint in free motion, rad/s (UR5: 3.14 at most).
        tool_speed: Speed of the tool on straight lines, m/s.

    Raises:
        RobotError: A speed is not above 0, or a position is not three numbers.
    """

    base: tuple[float, float, float]
    home: tuple[float, float, float]
    joint_speed: float
    tool_speed: float

    def __post_init__(self) -> None:
        for name in ("base", "home"):
            position = getattr(self, name)
            if not is_triple(position):
                raise RobotError(f"robot.arm.{name}={position} is no place: give [x,y,z] in metres")
        if not min(self.joint_speed, self.tool_speed) > 0:
            raise RobotError(
                f"robot.arm.joint_speed={self.joint_speed} and robot.arm.tool_speed={self.tool_speed} must be above 0"
            )


class Arm:
    """The arm with an end effector, in a simulation. All positions are of ``tool0``, which points down.

    Args:
        simulation: The world to load the arm into.
        config: Where the arm stands and how fast it moves.
        tool_urdf: URDF text of the arm with its end effector.
        jumps: Whether free motion skips the physics. Its duration is still counted.

    Raises:
        RobotError: The arm cannot reach home.
    """

    def __init__(self, simulation: Simulation, config: ArmConfig, tool_urdf: str, jumps: bool):
        self._simulation = simulation
        self._config = config
        self._urdf = tool_urdf
        self.jumps = jumps
        self.seconds = 0.0
        """Time that all motion since loading would take on a real arm at the configured speeds."""
        home = self.solve(np.array(config.home), HOME_ANGLE)
        if home is None:
            raise RobotError(f"robot.arm.home={config.home} is out of the arm's reach: move it nearer to the base")
        self._home = home

    def load(self) -> None:
        """Load the arm into an empty simulation, at home."""
        client = self._simulation.client
        path = file_of(self._urdf.encode(), ".urdf")
        self.body = client.loadURDF(str(path), basePosition=self._config.base, useFixedBase=True)
        infos = [client.getJointInfo(self.body, i) for i in range(client.getNumJoints(self.body))]
        self.joint_index = {info[1].decode(): i for i, info in enumerate(infos)}
        self.link_index = {info[12].decode(): i for i, info in enumerate(infos)}
        self._joints = [self.joint_index[name] for name in JOINTS]
        self.tool_links: list[int] = []
        """Links attached to ``tool0``."""
        for i, info in enumerate(infos):  # parents come before their children
            if info[16] in (self.link_index["tool0"], *self.tool_links):
                self.tool_links.append(i)
        self.seconds = 0.0
        self.teleport(self._home)

    def teleport(self, joints: Float[np.ndarray, "6"], velocity: Float[np.ndarray, "6"] | None = None) -> None:
        """Set the joint angles immediately, at rest or with a velocity in rad/s."""
        velocity = np.zeros(6) if velocity is None else velocity
        for index, value, speed in zip(self._joints, joints, velocity, strict=True):
            self._simulation.client.resetJointState(self.body, index, value, speed)
        self._command(joints, velocity)

    def solve(self, position: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "6"] | None:
        """Joint angles that put ``tool0`` at a world position, pointing down, rotated by ``angle``.

        The tool's x axis points along ``angle`` + pi. All tools here are symmetric under half a turn, and this half keeps the
        last joint away from its limits. Of the closed-form solutions, the one with the elbow up, the wrist inward and the base
        facing the bin is used, so that paths through neighbouring poses never jump. None if there is no such solution.
        """
        pose = np.eye(4)
        pose[:3, :3] = pointing_down(angle + np.pi)
        pose[:3, 3] = np.asarray(position) - self._config.base
        # The base frame of the kinematics is that of the URDF, rotated by half a turn about z.
        pose[:2] *= -1
        for solution in ur5.inverse_kinematics(pose):
            q = _wrap(solution)
            if abs(q[0]) < np.pi / 2 and q[2] > 0 and q[4] < 0:
                return q
        return None

    def line(self, start: np.ndarray, end: np.ndarray, angle: float, speed: float) -> Float[np.ndarray, "n 6"] | None:
        """Joint targets along a straight line, one per timestep; None if a point is out of reach."""
        length = float(np.linalg.norm(end - start))
        at = np.linspace(0, 1, 2 + int(np.ceil(length / KNOTS_APART)))
        knots = [self.solve(start + s * (end - start), angle) for s in at]
        if any(joints is None for joints in knots):
            return None
        return np.array(CubicSpline(at, np.array(knots))(_ease(length / speed)))

    def move(self, joints: Float[np.ndarray, "6"]) -> None:
        """Move freely in joint space."""
        start = self._joint_targets
        travel = float(np.abs(joints - start).max())
        steps = _ease(travel / self._config.joint_speed)[:, None]
        self.travel(start + steps * (joints - start))

    def home(self) -> None:
        """Move freely to the fixed initial position."""
        self.move(self._home)

    def travel(self, waypoints: Float[np.ndarray, "n 6"]) -> None:
        """Follow joint targets, one per timestep, where the tool holds nothing and should touch nothing."""
        if not self.jumps:
            self.follow(waypoints)
            return
        watched = self._simulation.after_step
        for joints in waypoints if watched else waypoints[-1:]:
            self.teleport(joints)
            if watched:
                watched()
        self.seconds += len(waypoints) * TIMESTEP

    def enter(self, waypoints: Float[np.ndarray, "n 6"], count: int) -> Float[np.ndarray, "m 6"]:
        """Jump over the first ``count`` targets of a line, where nothing can be touched, and continue at their speed.

        Returns:
            The targets that remain, at least one; all of them if free motion is simulated.
        """
        count = min(count, len(waypoints) - 1)
        if not self.jumps or count < 2:
            return waypoints
        self.travel(waypoints[:count])
        self.teleport(waypoints[count - 1], (waypoints[count - 1] - waypoints[count - 2]) / TIMESTEP)
        return waypoints[count:]

    def follow(self, waypoints: Float[np.ndarray, "n 6"], until: Callable[[], bool] | None = None) -> bool:
        """Drive through joint targets, one per timestep. If ``until`` returns True, stop early and hold the position.

        Returns:
            Whether it stopped early.
        """
        for target in waypoints:
            velocity = (target - self._joint_targets) / TIMESTEP
            self._command(target, velocity)
            self._simulation.step()
            self.seconds += TIMESTEP
            if until is not None and until():
                self._command(target, np.zeros(6))
                return True
        if len(waypoints):
            self._command(waypoints[-1], np.zeros(6))
        return False

    def wait(self, steps: int, until: Callable[[], bool] | None = None) -> None:
        """Hold still for ``steps`` timesteps, or until ``until`` returns True."""
        for _ in range(steps):
            self._simulation.step()
            self.seconds += TIMESTEP
            if until is not None and until():
                return

    def tool_position(self) -> Float[np.ndarray, "3"]:
        """The actual position of ``tool0``, world metres."""
        state = self._simulation.client.getLinkState(self.body, self.link_index["tool0"], computeForwardKinematics=1)
        return np.array(state[4])

    def tool_rotation(self) -> Float[np.ndarray, "3 3"]:
        """The actual rotation matrix of ``tool0``."""
        state = self._simulation.client.getLinkState(self.body, self.link_index["tool0"], computeForwardKinematics=1)
        return np.array(self._simulation.client.getMatrixFromQuaternion(state[5])).reshape(3, 3)

    @property
    def commanded_position(self) -> Float[np.ndarray, "3"]:
        """The last commanded position of ``tool0``, world metres."""
        return self.position(self._joint_targets)

    def position(self, joints: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3"]:
        """The position of ``tool0`` for given joint angles, world metres."""
        pose = np.array(ur5.forward_kinematics(*joints))
        return np.array([-pose[0, 3], -pose[1, 3], pose[2, 3]]) + self._config.base

    def _command(self, target: np.ndarray, velocity: np.ndarray) -> None:
        self._joint_targets = np.asarray(target, float)
        client = self._simulation.client
        client.setJointMotorControlArray(
            self.body,
            self._joints,
            client.POSITION_CONTROL,
            targetPositions=target,
            targetVelocities=velocity,
            forces=EFFORT,
            positionGains=[GAIN] * 6,
        )


def pointing_down(angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of a tool whose z axis points down and whose x axis is at ``angle`` from the world's x axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def _ease(seconds: float) -> Float[np.ndarray, " n"]:
    """Progress from 0 to 1, one value per timestep, smooth at both ends. The peak speed is 1 / ``seconds``."""
    n = max(1, int(np.ceil(seconds * np.pi / 2 / TIMESTEP)))
    return (1 - np.cos(np.pi * np.arange(1, n + 1) / n)) / 2


def _wrap(joints: np.ndarray) -> np.ndarray:
    return (np.asarray(joints) + np.pi) % (2 * np.pi) - np.pi
