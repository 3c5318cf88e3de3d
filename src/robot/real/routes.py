"""The ways that the arm takes above a bin: between home, the gate and poses with the tool pointing straight down."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from see2act.robot.arm import HOME_ANGLE, pointing_down
from see2act.robot.real.box import Box
from see2act.robot.real.operator import Operator
from see2act.robot.real.station import Joints, Station
from see2act.robot.real.ur import UrArm
from see2act.robot.types import RobotError

LIFT = 0.10
"""Metres (paper, section III-C)."""
AT_HOME = 0.02
"""Radians of the joints within which the arm counts as at home."""


class Routes:
    """Moves an arm where the way is known to be free.

    Home and the drop are taught joints. The gate is a pose above the middle of the bin, where motions of the joints end and
    straight ones begin. All heights are of the tool's tip above the bin's floor.

    Args:
        arm: Connected.
        station: With a home and a bin.
        operator: Is asked before the arm moves from an unknown place.
        clearance: Metres of the tool's tip above the floor at which it moves sideways: higher than everything in the bin.
        joint_speed: Of the fastest joint between taught places, rad/s.
        tool_speed: Of the tip above the bin, m/s.
        descent_speed: Of the tip on its way down and up, m/s.
    """

    def __init__(
        self,
        arm: UrArm,
        station: Station,
        operator: Operator,
        clearance: float,
        joint_speed: float,
        tool_speed: float,
        descent_speed: float,
    ):
        self._arm, self._station, self._operator = arm, station, operator
        self._clearance = clearance
        self._joint_speed, self._tool_speed, self._descent_speed = joint_speed, tool_speed, descent_speed
        self._world, self._box = station.world(), Box.above(station)

    def refuse_out_of_reach(self) -> None:
        """Ask the controller for all corners of the bin. Nothing moves.

        Raises:
            ArmError: It cannot reach one.
        """
        width, length = self._station.bin_size()
        for x in (-width / 2, width / 2):
            for y in (-length / 2, length / 2):
                for z in (0.0, self._clearance + LIFT):
                    self._arm.refuse_out_of_reach(self.at(x, y, z, HOME_ANGLE))

    def home(self) -> None:
        """Move to where the arm waits; from an unknown place only if a person agrees.

        Raises:
            RobotError: The person does not agree.
        """
        if self._is_at(self._taught("home")):
            return
        if self._is_at(self._gate_joints):
            self._arm.move_joints(self._taught("home"), self._joint_speed)
            return
        if not self._operator.agrees("The arm is not at home. It will rise straight up and then go home. Is the way free?"):
            raise RobotError("the arm is not at home: bring it there by hand, or agree that it goes there by itself")
        self.rise_and_go_home()

    def rise_and_go_home(self) -> None:
        """Move home from anywhere, more slowly."""
        if self._box.objection(self._arm.tip[:3, 3]) is None:
            self._arm.move_line(self._raised(self._clearance + LIFT), self._descent_speed, self._box)
            self._arm.move_line(self._gate(), self._descent_speed, self._box)
        self._arm.move_joints(self._taught("home"), self._joint_speed / 2)

    def to_gate(self) -> None:
        """From home to above the middle of the bin."""
        self._arm.move_joints(self._gate_joints, self._joint_speed)

    def back_to_gate(self) -> None:
        """From anywhere above the bin, at the height of the tip."""
        self._arm.move_line(self._gate(), self._tool_speed, self._box)

    def above(self, x: float, y: float, angle: float) -> None:
        """Sideways to above a place in the bin: world, metres and radians."""
        self._arm.move_line(self.at(x, y, self._clearance, angle), self._tool_speed, self._box)

    def down(self, x: float, y: float, z: float, angle: float, force_limit: float | None = None) -> float | None:
        """Straight down, or up, to a height there; the force that stopped the tip on its way, newtons."""
        return self._arm.move_line(self.at(x, y, z, angle), self._descent_speed, self._box, force_limit)

    def up(self, higher: float = 0.0) -> None:
        """Straight up to the clearance, or higher."""
        self._arm.move_line(self._raised(self._clearance + higher), self._descent_speed, self._box)

    def drop(self) -> None:
        """From the gate to where objects are let go."""
        self._arm.move_joints(self._taught("drop"), self._joint_speed)

    def at(self, x: float, y: float, z: float, angle: float) -> Float[np.ndarray, "4 4"]:
        """Pose of the tip in the controller's base, pointing straight down into the bin.

        The tool's x axis points along ``angle`` + pi in the world, as in the simulation.
        """
        tip = np.eye(4)
        tip[:3, :3] = pointing_down(angle + np.pi)
        tip[:3, 3] = x, y, z
        return self._world @ tip

    def _gate(self) -> Float[np.ndarray, "4 4"]:
        return self.at(0.0, 0.0, self._clearance + LIFT, HOME_ANGLE)

    def _raised(self, z: float) -> Float[np.ndarray, "4 4"]:
        """The present pose, with the tip at a height above the floor unless it is higher already."""
        tip = np.linalg.inv(self._world) @ self._arm.tip
        tip[2, 3] = max(tip[2, 3], z)
        return self._world @ tip

    @cached_property
    def _gate_joints(self) -> Joints:
        return self._arm.joints_at(self._gate(), near=self._taught("home"))

    def _taught(self, name: str) -> Joints:
        joints: Joints = getattr(self._station.robot, name)
        return joints

    def _is_at(self, joints: Joints) -> bool:
        return bool(np.abs(np.subtract(joints, self._arm.joints)).max() < AT_HOME)
