"""A suction cup: a bellows that must seal all around its rim and has a limited holding force."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from see2act.robot import urdf
from see2act.robot.arm import Arm
from see2act.robot.end_effector import EndEffector
from see2act.robot.simulation import Simulation
from see2act.robot.types import Cause, Limit, NotNegative

RIM_RAYS = 16
"""Rays from the rim that check the seal."""
ANCHORS = 4
"""Number of points of the rim that pull on the object. Together they transmit force and moment."""
MOVING_AND_STATIC, CUP = 3, 64
"""Collision groups: Bullet's own two, and a separate one for the cup, so that rays that start inside the cup ignore it."""


class SuctionCup(EndEffector):
    """Presses, seals and pulls. A pick succeeds if the vacuum is still there after the lift.

    A seal forms if the cup presses on a body and all rays from the rim meet that body, on a plane within ``flatness`` that is
    tilted by at most ``tilt``. The cup then pulls with a force of pressure times area, spread over the rim. One side of the
    rim comes off if the object is too heavy, stuck, or held too far from its centre of mass.

    Args:
        holder_length, holder_radius: Size of the tube, metres.
        cup_length, cup_radius: Size of the bellows, metres.
        travel: Metres by which the bellows can be compressed.
        stiffness: Newtons that compress the bellows.
        press: Metres below the surface to which the rim is sent.
        flatness: Largest distance of the surface from a plane that the lip can follow, metres.
        tilt: Largest angle between the cup and the surface, radians.
        vacuum: Pressure below ambient with a perfect seal, kPa.
        leak: Share of the vacuum that is lost on a surface at the limit of ``flatness``.
        open_pressure: Pressure below ambient while the pump draws free air, kPa.
        threshold: Pressure difference above which an object counts as held, kPa.
        peel: Metres by which a point of the rim may come off before the seal is lost.
        contact_limit: Contact force at which a descent stops, newtons.
    """

    primitive = "suction"

    def __init__(
        self,
        holder_length: NotNegative,
        holder_radius: NotNegative,
        cup_length: NotNegative,
        cup_radius: NotNegative,
        travel: NotNegative,
        stiffness: NotNegative,
        press: NotNegative,
        flatness: NotNegative,
        tilt: NotNegative,
        vacuum: NotNegative,
        leak: NotNegative,
        open_pressure: NotNegative,
        threshold: NotNegative,
        peel: NotNegative,
        contact_limit: Limit,
    ):
        self._holder_length, self._holder_radius = holder_length, holder_radius
        self._cup_length, self.cup_radius = cup_length, cup_radius
        self._travel, self._stiffness, self.press = travel, stiffness, press
        self.flatness, self.tilt = flatness, tilt
        self._vacuum, self._leak, self._open = vacuum, leak, open_pressure
        self._threshold, self._peel = threshold, peel
        self.contact_limit = contact_limit

    def urdf(self) -> ET.Element:
        return urdf.suction_tip(self._holder_length, self._holder_radius, self._cup_length, self.cup_radius, self._travel)

    def bind(self, simulation: Simulation, arm: Arm) -> None:
        self._simulation, self._arm = simulation, arm
        self._cup = arm.link_index["suction_cup"]
        self._seal: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._sealed_body = -1
        self.pressure = self._before = 0.0
        client = simulation.client
        client.changeDynamics(arm.body, self._cup, lateralFriction=0.9)
        client.setCollisionFilterGroupMask(arm.body, self._cup, CUP, -1)
        client.setJointMotorControl2(
            arm.body, arm.joint_index["cup_joint"], client.POSITION_CONTROL, 0.0, force=self._stiffness, maxVelocity=0.5
        )

    def length(self) -> float:
        return self._holder_length + self._cup_length

    def depth_at(self, surface: np.ndarray) -> np.ndarray:
        return np.maximum(surface - self.press, 0.0)

    def prepare(self) -> None:
        self.release()
        self._before = self.pressure = self._open

    def engage(self) -> None:
        self._arm.wait(8)
        body, quality = self._touch()
        self._had_seal = body is not None
        if body is not None:
            self.pressure = self._vacuum * quality
            self._attach(body)

    def engaged(self) -> bool:
        return self._had_seal

    def why_failed(self, engaged: bool, blocked: bool) -> Cause:
        return "slipped" if engaged else "no_seal"

    def update_hold(self) -> None:
        if self._seal and max(self._gaps()) > self._peel:
            self.release()

    def sense(self) -> tuple[float, bool]:
        difference = self.pressure - self._before
        return difference, difference > self._threshold

    def release(self) -> None:
        for constraint, _, _ in self._seal:
            self._simulation.client.removeConstraint(constraint)
        self._seal = []
        self._had_seal = False
        self.pressure = self._open

    def _touch(self) -> tuple[int | None, float]:
        """The body under the whole rim and the quality of the seal on it; None and 0 if there is no seal."""
        position, rotation = self._cup_frame()
        rim = self._rim(RIM_RAYS)
        starts = (rim - [0, 0, 0.006]) @ rotation.T + position
        ends = (rim + [0, 0, 0.012]) @ rotation.T + position
        hits = self._simulation.cast(starts, ends, MOVING_AND_STATIC)
        bodies = set(hits.body.tolist())
        if len(bodies) != 1 or bodies & {-1, self._arm.body}:
            return None, 0.0
        centred = hits.position - hits.position.mean(0)
        normal = np.linalg.svd(centred)[2][2]
        off_plane = float(np.abs(centred @ normal).max())
        tilt = float(np.arccos(min(1.0, abs(normal @ rotation[:, 2]))))
        body = bodies.pop()
        pressed = any(p[9] > 0 for p in self._simulation.client.getContactPoints(self._arm.body, body, self._cup))
        if off_plane > self.flatness or tilt > self.tilt or not pressed:
            return None, 0.0
        return body, 1 - self._leak * off_plane / self.flatness

    def _attach(self, body: int) -> None:
        client = self._simulation.client
        position, rotation = self._cup_frame()
        at, turn = client.getBasePositionAndOrientation(body)
        body_rotation = np.array(client.getMatrixFromQuaternion(turn)).reshape(3, 3)
        force = self.pressure * 1000 * np.pi * self.cup_radius**2
        # The origin of a link's constraint frame is its centre of mass, half-way up the cup.
        for point in self._rim(ANCHORS):
            on_body = body_rotation.T @ (rotation @ point + position - at)
            on_link = point + [0, 0, self._cup_length / 2]
            constraint = client.createConstraint(
                self._arm.body, self._cup, body, -1, client.JOINT_POINT2POINT, (0, 0, 0), on_link.tolist(), on_body.tolist()
            )
            client.changeConstraint(constraint, maxForce=force / ANCHORS)
            self._seal.append((constraint, point, on_body))
        self._sealed_body = body

    def _gaps(self) -> list[float]:
        """Metres between each anchor on the rim and the point of the object that it was attached to."""
        client = self._simulation.client
        position, rotation = self._cup_frame()
        at, turn = client.getBasePositionAndOrientation(self._sealed_body)
        body_rotation = np.array(client.getMatrixFromQuaternion(turn)).reshape(3, 3)
        return [
            float(np.linalg.norm(rotation @ point + position - body_rotation @ on_body - at))
            for _, point, on_body in self._seal
        ]

    def _cup_frame(self) -> tuple[np.ndarray, np.ndarray]:
        """World position of the rim's centre, and the cup's rotation matrix; its z axis points out of the cup."""
        client = self._simulation.client
        state = client.getLinkState(self._arm.body, self._cup, computeForwardKinematics=1)
        rotation = np.array(client.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        return np.array(state[4]) + rotation[:, 2] * self._cup_length, rotation

    def _rim(self, n: int) -> np.ndarray:
        """``n`` points on the rim, in the rim's frame, metres."""
        angles = 2 * np.pi * np.arange(n) / n
        return self.cup_radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])
