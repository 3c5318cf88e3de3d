"""A real UR5 over a bin: the same questions and answers as the simulated one."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from see2act.robot import heightmap as hm
from see2act.robot.arm import HOME_ANGLE, pointing_down
from see2act.robot.end_effector import EndEffector
from see2act.robot.objects import ObjectSet
from see2act.robot.real import station as stations
from see2act.robot.real import tools
from see2act.robot.real.box import Box
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import Cell, connected
from see2act.robot.real.operator import Operator, Terminal
from see2act.robot.real.station import Joints, Station
from see2act.robot.real.ur import ProtectiveStop, UrArm
from see2act.robot.robot import Robot
from see2act.robot.types import Cause, Heightmap, NotNegative, Observation, Outcome, Pick, RobotError, Split
from see2act.robot.workspace import Workspace

LIFT = 0.10
"""Metres (paper, section III-C)."""
HOLD_SECONDS = 0.5
"""Seconds after the lift until the sensor is read again; the hold must last that long."""
AT_HOME = 0.02
"""Radians of the joints within which the arm counts as at home."""
HOVER = 0.10
"""Metres above a pick at which a dry run ends."""
CENTRE = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From pixel centres at the index, as cameras give intrinsics, to centres at the index and a half, as heightmaps take them."""
ALMOST_FLOOR = 0.01
"""Metres above the floor up to which a cell of the heightmap counts as empty."""
CROWDED = 50
"""Square millimetres above that height with which the bin is not empty: a coin's worth of noise at walls is about 20."""


class RealRobot(Robot):
    """A UR5 with an RG2 or a cup, and a depth camera. Building one connects to nothing.

    Args:
        workspace: Grid of the heightmap, in the middle of the bin.
        camera: Of :mod:`see2act.robot.real`.
        objects: The objects that a person puts into the bin; only their number and the name of the set are used.
        end_effector: The simulated tool that the station's stands for; it must serve the same primitive.
        station: Path of the station's file.
        clearance: Metres of the tool's tip above the floor at which it moves sideways: higher than everything in the bin.
        joint_speed: Of the fastest joint between taught places, rad/s.
        tool_speed: Of the tip above the bin, m/s.
        descent_speed: Of the tip on its way down and up, m/s.
        contact_limit: Force at which a descent stops, newtons. The estimate of a UR5 without a force sensor is 10 N off.
        dry_run: Whether to stop 10 cm above each pick.
        operator: Who fills the bin; None for the person at the terminal.

    Raises:
        RobotError: The station lacks something, or does not fit the workspace, the camera or the tool.
    """

    attended = True

    def __init__(
        self,
        workspace: Workspace,
        camera: DepthCamera,
        objects: ObjectSet,
        end_effector: EndEffector,
        station: str,
        clearance: NotNegative,
        joint_speed: NotNegative,
        tool_speed: NotNegative,
        descent_speed: NotNegative,
        contact_limit: NotNegative,
        dry_run: bool = False,
        operator: Operator | None = None,
    ):
        self._path = Path(station).expanduser()
        self.station = stations.load(self._path)
        self._camera = camera
        self.workspace = workspace
        self.primitive = end_effector.primitive
        _refuse_unfit(self.station, workspace, camera, self.primitive)
        self.half_opening = tools.build(self.station.tool, UrArm(self.station)).half_opening
        self._objects = objects
        self._clearance, self._contact_limit = clearance, contact_limit
        self._joint_speed, self._tool_speed, self._descent_speed = joint_speed, tool_speed, descent_speed
        self._dry_run = dry_run
        self._operator = operator or Terminal()
        self._world, self._box = self.station.world(), Box.above(self.station)
        self._seen: Observation | None = None
        """Of the bin as it is: nothing has moved since."""

    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        """Ask the person for a new scene. ``scene_seed`` names it, and decides nothing."""
        self._go_home()
        amount = f"{count or self._objects.kinds * self._objects.copies} of the {split} objects of {self._objects.name}"
        self._operator.ask(f"Scene {scene_seed}: empty the bin, put in {amount}, stir, and step back. Then press Enter.")
        self._seen = None

    def resume(self, scene_seed: int, attempts: int) -> bool:
        """Ask whether the scene is as an interrupted run left it."""
        self._go_home()
        self._seen = None
        return self._operator.agrees(
            f"The run goes on in scene {scene_seed} after {attempts} attempts. Is the bin as they left it?"
        )

    def background(self) -> Heightmap:
        """Heightmap of the empty bin, as `real.py background` saw it."""
        assert self.station.background is not None, "the constructor refuses a station without one"
        with np.load(self._path.parent / self.station.background) as images:
            return self._heightmap(images["color"], self._corrected(images["depth"]), images["intrinsics"])

    def observe(self) -> Observation:
        if self._seen is None:
            self._go_home()
            frame = self._cell.camera.read()
            depth = self._corrected(frame.depth)
            heightmap = self._heightmap(frame.color, depth, self._cell.camera.intrinsics)
            self._seen = Observation(heightmap, frame.color, depth)
        return self._seen

    def execute(self, pick: Pick) -> Outcome:
        self._go_home()
        self._seen = None
        start = time.monotonic()
        try:
            cause, reading = self._attempt(pick)
        except ProtectiveStop as stop:
            self._wait_for_a_person(str(stop))
            cause, reading = "protective_stop", 0.0
        return Outcome(cause == "ok", None, cause, reading, time.monotonic() - start, 0)

    def bin_empty(self) -> bool:
        above = (self.observe().heightmap.height > ALMOST_FLOOR) & self.observe().heightmap.valid
        return bool(above.sum() * (1000 * self.workspace.pixel) ** 2 < CROWDED)

    def close(self) -> None:
        """Nothing: the devices stay connected until the program ends, for the next robot that is built in it."""

    # An attempt

    def _attempt(self, pick: Pick) -> tuple[Cause, float]:
        """Why it failed or ``ok``, and the reading that decided."""
        arm, tool = self._cell.arm, self._cell.tool
        depth = self.station.tool.depth
        bottom = max(pick.z - depth, self.station.tool.floor_gap)
        above = self._at(pick.x, pick.y, max(self._clearance, bottom), pick.angle)
        self._to_gate()
        tool.prepare()
        arm.move_line(above, self._tool_speed, self._box)
        if self._dry_run:
            hover = self._at(pick.x, pick.y, min(max(pick.z + HOVER, bottom), self._clearance), pick.angle)
            arm.move_line(hover, self._descent_speed, self._box)
            return self._end_without("dry_run", 0.0)
        blocked = arm.move_line(
            self._at(pick.x, pick.y, bottom, pick.angle), self._descent_speed, self._box, force_limit=self._contact_limit
        )
        tool.engage()
        engaged = tool.holds(tool.reading())
        arm.move_line(self._raised(self._clearance + LIFT), self._descent_speed, self._box)
        time.sleep(HOLD_SECONDS)
        reading = tool.reading()
        if not tool.holds(reading):
            failed: Cause = "missed" if self.primitive == "grasp" else "no_seal"
            return self._end_without(
                "slipped" if engaged else "collision" if blocked and self.half_opening else failed, reading
            )
        arm.move_line(self._gate(), self._tool_speed, self._box)
        arm.move_joints(self._taught("drop"), self._joint_speed)
        tool.release()
        arm.move_joints(self._gate_joints, self._joint_speed)
        self._go_home()
        return "ok", reading

    def _end_without(self, cause: Cause, reading: float) -> tuple[Cause, float]:
        """Go home with an empty tool."""
        arm = self._cell.arm
        arm.move_line(self._raised(self._clearance), self._descent_speed, self._box)
        self._cell.tool.release()
        arm.move_line(self._gate(), self._tool_speed, self._box)
        self._go_home()
        return cause, reading

    def _wait_for_a_person(self, reason: str) -> None:
        """After a protective stop: nothing is cleared and nothing moves before somebody has looked."""
        while not self._operator.agrees(
            f"{reason}. The attempt is given up. When it is unlocked and hands are out of reach, the tool will open, rise "
            "straight up and go home. May it?"
        ):
            pass
        try:
            self._cell.arm.check_ready()
        except ProtectiveStop as still:
            self._wait_for_a_person(str(still))
            return
        self._cell.tool.release()
        self._rise_and_go_home()

    # Places

    def _go_home(self) -> None:
        """Move to where the arm waits; from an unknown place only if a person agrees."""
        arm, home = self._cell.arm, self._taught("home")
        if _near(arm.joints, home):
            return
        if not _near(arm.joints, self._gate_joints):
            if not self._operator.agrees("The arm is not at home. It will rise straight up and then go home. Is the way free?"):
                raise RobotError("the arm is not at home: bring it there by hand, or agree that it goes there by itself")
            self._rise_and_go_home()
            return
        arm.move_joints(home, self._joint_speed)

    def _rise_and_go_home(self) -> None:
        arm = self._cell.arm
        if self._box.objection(arm.tip[:3, 3]) is None:
            arm.move_line(self._raised(self._clearance + LIFT), self._descent_speed, self._box)
            arm.move_line(self._gate(), self._descent_speed, self._box)
        arm.move_joints(self._taught("home"), self._joint_speed / 2)

    def _to_gate(self) -> None:
        self._cell.arm.move_joints(self._gate_joints, self._joint_speed)

    def _gate(self) -> Float[np.ndarray, "4 4"]:
        """Above the middle of the bin. Joint motions end and straight ones begin there."""
        return self._at(0.0, 0.0, self._clearance + LIFT, HOME_ANGLE)

    def _at(self, x: float, y: float, z: float, angle: float) -> Float[np.ndarray, "4 4"]:
        """Pose of the tip in the controller's base, pointing straight down into the bin.

        The tool's x axis points along ``angle`` + pi in the world, as in the simulation.
        """
        tip = np.eye(4)
        tip[:3, :3] = pointing_down(angle + np.pi)
        tip[:3, 3] = x, y, z
        return self._world @ tip

    def _raised(self, z: float) -> Float[np.ndarray, "4 4"]:
        """The present pose, with the tip at a height above the floor unless it is higher already."""
        tip = np.linalg.inv(self._world) @ self._cell.arm.tip
        tip[2, 3] = max(tip[2, 3], z)
        return self._world @ tip

    @cached_property
    def _gate_joints(self) -> Joints:
        return self._cell.arm.joints_at(self._gate(), near=self._taught("home"))

    def _taught(self, name: str) -> Joints:
        joints: Joints = getattr(self.station.robot, name)
        return joints

    @property
    def _cell(self) -> Cell:
        cell = connected(self._path, self.station, self._camera)
        calibration = self.station.calibration
        assert calibration is not None
        if cell.camera.serial != calibration.serial:
            raise RobotError(
                f"the camera is {cell.camera.serial}, and the station was calibrated with {calibration.serial}: connect that "
                "one, or type `python real.py calibrate`"
            )
        return cell

    # Images

    def _corrected(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Depth by the station's calibration, metres; 0 stays 0."""
        calibration = self.station.calibration
        assert calibration is not None
        true = calibration.depth_scale * depth + calibration.depth_offset
        return np.where(depth > 0, true, 0).astype(np.float32)

    def _heightmap(self, color: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray) -> Heightmap:
        calibration = self.station.calibration
        assert calibration is not None
        pose = np.linalg.inv(self._world) @ np.array(calibration.camera)
        return hm.project(color, depth, hm.point_cloud(depth, intrinsics + CENTRE, pose), self.workspace)


def _refuse_unfit(station: Station, workspace: Workspace, camera: DepthCamera, primitive: str) -> None:
    """Refuse what can be known without touching a device."""
    if not isinstance(camera, DepthCamera):
        raise RobotError("robot=ur5_real needs a real camera: add camera=realsense or camera=files")
    if station.primitive != primitive:
        raise RobotError(
            f"the station's {station.tool.kind} cannot do primitive={primitive}: use primitive={station.primitive}"
        )
    for name in ("home", "drop"):
        if getattr(station.robot, name) is None:
            raise RobotError(f"the station has no place {name}: type `python real.py teach`")
    width, length = station.bin_size()
    if workspace.width > width + 0.02 or workspace.length > length + 0.02:
        raise RobotError(
            f"workspace={workspace.name} is {workspace.width} by {workspace.length} m, and the taught bin {width:.3f} by "
            f"{length:.3f} m: choose a smaller one with workspace.width= and workspace.length=, or a larger bin"
        )
    if station.calibration is None:
        raise RobotError("the station has no calibration: type `python real.py calibrate`")
    if station.background is None:
        raise RobotError("the station has no image of the empty bin: type `python real.py background`")


def _near(joints: Joints, others: Joints) -> bool:
    return bool(np.abs(np.subtract(joints, others)).max() < AT_HOME)
