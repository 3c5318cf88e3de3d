"""The Robotiq 2F-85: a parallel gripper with a mimic linkage."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import deque
from typing import Annotated

import numpy as np
from annotated_types import Ge

from see2act.robot import urdf
from see2act.robot.arm import Arm
from see2act.robot.end_effector import EndEffector
from see2act.robot.simulation import Simulation
from see2act.robot.types import Cause, Limit, NotNegative

DRIVER = "gripper_finger_joint"
FOLLOWERS = {
    "gripper_right_outer_knuckle_joint": 1.0,
    "gripper_left_inner_finger_joint": -1.0,
    "gripper_right_inner_finger_joint": -1.0,
}
"""Multipliers of the URDF's <mimic> elements, which PyBullet ignores."""
PADS = ("gripper_left_inner_finger_pad", "gripper_right_inner_finger_pad")
CRANK = 0.0572
"""Metres from knuckle to fingertip joint: the radius of the pads' arc (URDF)."""
CRANK_OPEN = 0.715
"""Radians between the crank and the vertical when open (URDF)."""
PAD_AT_KNUCKLE = 0.005
"""Half of the opening at which the crank is vertical, metres."""
PAD_HALF_HEIGHT = 0.01875
"""Half of the height of a pad, metres."""
PAD_CENTRE = 0.130
"""Metres from ``tool0`` to the midpoint between the open pads (measured on the loaded model)."""
STILL_STEPS = 12
STILL = 0.001
"""Fingers are at rest if the driver joint stays within this many radians for ``STILL_STEPS``: 0.02 rad/s. The momentary speed
cannot be used: fingers that squeeze an object tremble at up to 0.05 rad/s without moving on."""
OPEN, CLOSED = 0.0, 0.8
"""Angles of the driver joint, radians."""
FLOOR_GAP = 0.002
"""Smallest distance between the closing pads and the floor, metres."""


class Gripper(EndEffector):
    """Closes on an object between its pads. A pick succeeds if the opening of the fingers stays above a threshold.

    Args:
        depth: Metres below the surface to which the middle of the pads is sent.
        torque: Torque of the driver joint, N m; 2 N m gives about 20 N at the pads.
        speed: Speed of the driver joint, rad/s.
        close_steps: Maximum number of timesteps for closing.
        threshold: Opening above which an object counts as held, metres.
        friction: Coulomb coefficient of the rubber pads.
        contact_limit: Contact force at which a descent stops, newtons.
        size: Scale factor of the 2F-85, which opens 86 mm; with 1.28 it opens as far as OnRobot's RG2, 110 mm.
    """

    primitive = "grasp"

    def __init__(
        self,
        depth: float,
        torque: NotNegative,
        speed: NotNegative,
        close_steps: Annotated[int, Ge(1)],
        threshold: NotNegative,
        friction: NotNegative,
        contact_limit: Limit,
        size: NotNegative = 1.0,
    ):
        self.depth = depth
        self._torque = torque
        self._speed = speed
        self._close_steps = close_steps
        self.threshold = threshold
        self._friction = friction
        self.contact_limit = contact_limit
        self.size = size
        self.half_opening = self.opening(0.0) / 2

    def urdf(self) -> ET.Element:
        return urdf.robotiq(self.size)

    def bind(self, simulation: Simulation, arm: Arm) -> None:
        self._simulation, self._arm = simulation, arm
        client = simulation.client
        self._driver = arm.joint_index[DRIVER]
        self._followers = [arm.joint_index[name] for name in FOLLOWERS]
        for follower, multiplier in zip(self._followers, FOLLOWERS.values(), strict=True):
            client.setJointMotorControl2(arm.body, follower, client.VELOCITY_CONTROL, force=0)
            gear = client.createConstraint(
                arm.body, self._driver, arm.body, follower, client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
            )
            client.changeConstraint(gear, gearRatio=-multiplier, maxForce=100, erp=1)
        for name in PADS:
            # The anchor corrects the drift of sticking contacts, within Coulomb's limit. Without it a held object creeps.
            client.changeDynamics(
                arm.body, arm.link_index[name], lateralFriction=self._friction, spinningFriction=0.005, frictionAnchor=1
            )
        self._recent: deque[float] = deque(maxlen=STILL_STEPS + 1)
        self.drive(OPEN)

    def length(self) -> float:
        return PAD_CENTRE * self.size

    def depth_at(self, surface: np.ndarray) -> np.ndarray:
        return np.maximum(surface - self.depth, self.reach() + FLOOR_GAP)

    def reach(self) -> float:
        """Metres from the middle of the open pads down to the lower ends of the closed ones."""
        return float(PAD_HALF_HEIGHT * self.size + self.swing(np.array(0.0)))

    def opening(self, angle: float) -> float:
        """Metres between the pads at a driver joint angle in radians."""
        return float(2 * self.size * (PAD_AT_KNUCKLE + CRANK * np.sin(CRANK_OPEN - angle)))

    def present_opening(self) -> float:
        """Metres between the pads now."""
        return self.opening(self._angle())

    def swing(self, width: np.ndarray) -> np.ndarray:
        """Metres by which the pads, which close along an arc, are lower at an opening of ``width`` metres than fully open."""
        sine = (width / 2 / self.size - PAD_AT_KNUCKLE) / CRANK
        return self.size * CRANK * (np.sqrt(1 - sine.clip(0, np.sin(CRANK_OPEN)) ** 2) - np.cos(CRANK_OPEN))

    def prepare(self) -> None:
        if self._arm.jumps:
            return  # it has been open since the last release
        seconds = self._arm.seconds
        self.drive(OPEN)
        self._wait_until_still()
        self._arm.seconds = seconds  # not counted: a real gripper opens while the arm moves

    def engage(self) -> None:
        self.drive(CLOSED)
        self._wait_until_still()

    def engaged(self) -> bool:
        return self.present_opening() > self.threshold

    def why_failed(self, engaged: bool, blocked: bool) -> Cause:
        return "collision" if blocked else "slipped"

    def update_hold(self) -> None:
        """Record the finger position. Whether the hold lasts is decided by friction in the simulation."""
        self._recent.append(self._angle())

    def sense(self) -> tuple[float, bool]:
        # Fingers that have just lost an object are still closing, and for a moment as far apart as if they held it.
        self._wait_until_still()
        gap = self.present_opening()
        return gap, gap > self.threshold

    def release(self) -> None:
        if self._arm.jumps:
            for joint in (self._driver, *self._followers):
                self._simulation.client.resetJointState(self._arm.body, joint, 0.0)
        self.drive(OPEN)

    def _wait_until_still(self) -> None:
        def still() -> bool:
            self.update_hold()
            return self.still()

        if not self.still():
            self._arm.wait(self._close_steps, still)

    def still(self) -> bool:
        """Whether the driver joint has not moved in the last ``STILL_STEPS`` calls of :meth:`update_hold`."""
        return len(self._recent) > STILL_STEPS and max(self._recent) - min(self._recent) < STILL

    def _angle(self) -> float:
        return float(self._simulation.client.getJointState(self._arm.body, self._driver)[0])

    def drive(self, target: float) -> None:
        """Begin to open or close: to :data:`OPEN` or :data:`CLOSED`."""
        self._recent.clear()
        client = self._simulation.client
        client.setJointMotorControl2(
            self._arm.body, self._driver, client.POSITION_CONTROL, target, force=self._torque, maxVelocity=self._speed
        )
