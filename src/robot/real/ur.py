"""A UR arm by the client ur_rtde: bounded motions that are watched while they run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from see2act.robot.real.box import Box
from see2act.robot.real.controller import POLL, SLOWEST, ArmError, LinkLost, OutOfReach, ProtectiveStop, UrController
from see2act.robot.real.station import Joints, Station, pose

SLOW = 0.25
"""Share of the speed until a touch test was clean."""
SPARE_TIME = 10.0
"""Seconds that a motion may take longer than twice what its length and speed say. The controller limits the force meanwhile."""
DECELERATION = 2.0
"""m/s^2 with which a straight motion is stopped: at 0.25 m/s it ends after 16 mm."""
JOINT_DECELERATION = 4.0
"""rad/s^2, for a motion of the joints."""
ACCELERATION = 0.5
"""m/s^2 and rad/s^2, of all motions."""
REACHED, TURNED = 0.002, 0.02
"""Metres and radians from its target within which a motion must end. A UR5 repeats a pose within 0.1 mm."""
SETTLE = 0.3
"""Seconds after a motion in which the arm must have come to rest at its target."""


class UrArm(UrController):
    """The arm of a station.

    Before every motion the robot's and the safety's modes are read, and the controller is asked whether it can reach the
    target. While it runs they are read every 10 ms; an error, a force or Ctrl-C stops the arm. Afterwards the pose is
    compared with the target.

    Args:
        station: Address, tool and, before a clean touch test, the reason to be slow.
    """

    def __init__(self, station: Station):
        super().__init__(station)
        self._share = 1.0 if station.trusted else SLOW

    def move_joints(self, joints: Joints, speed: float) -> None:
        """Move in joint space to a configuration that a person has taught, or that is known from one.

        Args:
            joints: Radians.
            speed: Of the fastest joint, rad/s, before a touch test reduced.

        Raises:
            ArmError: See the class.
        """
        self.check_ready()
        if not self._ask("isJointsWithinSafetyLimits", list(joints)):
            raise ArmError("the controller's safety limits do not allow the joints of a taught place: teach it again")
        speed *= self._share
        travel = float(np.abs(np.subtract(joints, self.joints)).max())
        self._run(lambda: self._do("moveJ", list(joints), speed, ACCELERATION, True), travel / speed, straight=False)
        if not self._settled(lambda: bool(np.abs(np.subtract(joints, self.joints)).max() < TURNED)):
            raise ArmError("the arm has stopped before it reached a taught place: see what holds it")

    def move_line(
        self, target: Float[np.ndarray, "4 4"], speed: float, box: Box, force_limit: float | None = None
    ) -> float | None:
        """Move the tip in a straight line.

        Args:
            target: Where to.
            speed: m/s, before a touch test reduced.
            box: That the tip must not leave. It is convex, so a line between two points in it stays in it.
            force_limit: Newtons beyond the force at the start, at which the motion stops.

        Returns:
            The force that stopped it, newtons; None if it arrived.

        Raises:
            ArmError: See the class.
        """
        self.check_ready()
        for name, place in (("the tip is", self.tip), ("the target is", target)):
            if reason := box.objection(place[:3, 3]):
                raise ArmError(f"{name} {reason}")
        self.refuse_out_of_reach(target)
        speed *= self._share
        before, stopped_by = self.force, None

        def too_strong() -> bool:
            nonlocal stopped_by
            force = float(np.linalg.norm(self.force - before))
            stopped_by = force if force_limit is not None and force > force_limit else None
            return stopped_by is not None

        length = float(np.linalg.norm(target[:3, 3] - self.tip[:3, 3])) + 0.1 * _angle(target, self.tip)
        self._run(lambda: self._do("moveL", list(pose(target)), speed, ACCELERATION, True), length / speed, True, too_strong)
        if stopped_by is None:
            self._refuse_another_place(target)
        return stopped_by

    def joints_at(self, target: Float[np.ndarray, "4 4"], near: Joints) -> Joints:
        """The joints, nearest to given ones, with the tip at a pose.

        Raises:
            ArmError: There are none.
        """
        self.refuse_out_of_reach(target)
        return tuple(self._call(self._control.getInverseKinematics, list(pose(target)), list(near)))

    def refuse_out_of_reach(self, target: Float[np.ndarray, "4 4"]) -> None:
        """Ask the controller whether the tip can be at a pose, within the safety limits. Nothing moves.

        Raises:
            OutOfReach: It cannot.
        """
        if not self._ask("isPoseWithinSafetyLimits", list(pose(target))):
            raise OutOfReach(
                f"the arm cannot reach {_place(target)} m, or its safety limits forbid it: move the bin, or change the limits"
            )

    def stop(self) -> None:
        """Stop at once."""
        self._call(self._control.stopL, DECELERATION)

    @contextmanager
    def led_by_hand(self) -> Iterator[None]:
        """The arm gives way to a person's hand in the block.

        Raises:
            ArmError: It must not move.
        """
        self.check_ready()
        self._do("freedriveMode")
        try:
            yield
        finally:
            self._do("endFreedriveMode")
            time.sleep(SETTLE)  # until the arm is at rest, and its last pose has come

    # What motions are made of

    def _run(
        self, start: Callable[[], None], seconds: float, straight: bool, until: Callable[[], bool] = lambda: False
    ) -> None:
        """Start a motion and watch it to its end."""
        before = self._operation().operationId()
        deadline = time.monotonic() + SPARE_TIME + 2 * seconds / max(self._receive.getTargetSpeedFraction(), SLOWEST)
        try:
            start()
            while (now := self._operation()).operationId() == before or now.isAsyncOperationRunning():
                self._refuse_to_go_on()
                if until():
                    self.stop()
                    return
                if time.monotonic() > deadline:
                    raise ArmError("a motion did not end in time, and was stopped: see what holds the arm, and the slider")
                time.sleep(POLL)
        except BaseException as error:  # Ctrl-C too
            if not isinstance(error, LinkLost | ProtectiveStop):
                self._call(*((self._control.stopL, DECELERATION) if straight else (self._control.stopJ, JOINT_DECELERATION)))
            raise
        self._refuse_to_go_on()

    def _operation(self) -> Any:
        return self._call(self._control.getAsyncOperationProgressEx)

    def _refuse_another_place(self, target: Float[np.ndarray, "4 4"]) -> None:
        def off() -> tuple[float, float]:
            return float(np.linalg.norm(self.tip[:3, 3] - target[:3, 3])), _angle(self.tip, target)

        if not self._settled(lambda: bool(np.all(np.array(off()) < (REACHED, TURNED)))):
            metres, turned = off()
            raise ArmError(
                f"the arm has stopped {1000 * metres:.0f} mm and {np.degrees(turned):.0f} degrees from {_place(target)} m: see "
                "what holds it, and whether the payload in the station is right"
            )

    def _settled(self, there: Callable[[], bool]) -> bool:
        """Whether the arm is where it should be, a moment after its motion: the pose arrives later than the news of the end."""
        deadline = time.monotonic() + SETTLE
        while not there():
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL)
        return True


def _angle(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> float:
    return float(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude())


def _place(target: Float[np.ndarray, "4 4"]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in target[:3, 3]) + ")"
