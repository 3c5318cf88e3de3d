"""A real UR5 over a bin: the same questions and answers as the simulated one."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path

from see2act.files import read_arrays
from see2act.robot.end_effector import EndEffector
from see2act.robot.objects import ObjectSet
from see2act.robot.real import station as stations
from see2act.robot.real import tools
from see2act.robot.real.camera import DepthCamera
from see2act.robot.real.cell import Cell, connected
from see2act.robot.real.controller import ProtectiveStop
from see2act.robot.real.operator import Operator, Terminal
from see2act.robot.real.projection import Projection
from see2act.robot.real.routes import LIFT, Routes
from see2act.robot.real.station import Station
from see2act.robot.real.ur import UrArm
from see2act.robot.robot import Robot
from see2act.robot.types import Cause, Heightmap, NotNegative, Observation, Outcome, Pick, RobotError, Split
from see2act.robot.workspace import Workspace

HOLD_SECONDS = 0.5
"""Seconds after the lift until the sensor is read again; the hold must last that long."""
HOVER = 0.10
"""Metres above a pick at which a dry run ends."""
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
        self._speeds = joint_speed, tool_speed, descent_speed
        self._dry_run = dry_run
        self._operator = operator or Terminal()
        self._projection = Projection(self.station)
        self._seen: Observation | None = None
        """Of the bin as it is: nothing has moved since."""

    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        """Ask the person for a new scene. ``scene_seed`` names it, and decides nothing."""
        self._routes.home()
        amount = f"{count or self._objects.kinds * self._objects.copies} of the {split} objects of {self._objects.name}"
        self._operator.ask(f"Scene {scene_seed}: empty the bin, put in {amount}, stir, and step back. Then press Enter.")
        self._seen = None

    def resume(self, scene_seed: int, attempts: int) -> bool:
        """Ask whether the scene is as an interrupted run left it."""
        self._routes.home()
        self._seen = None
        return self._operator.agrees(
            f"The run goes on in scene {scene_seed} after {attempts} attempts. Is the bin as they left it?"
        )

    def background(self) -> Heightmap:
        """Heightmap of the empty bin, as `real.py background` saw it."""
        assert self.station.background is not None, "the constructor refuses a station without one"
        images = read_arrays(self._path.parent / self.station.background, ("color", "depth", "intrinsics"))
        return self._projection.heightmap(images["color"], images["depth"], images["intrinsics"], self.workspace)

    def observe(self) -> Observation:
        if self._seen is None:
            self._routes.home()
            frame = self._cell.camera.read()
            intrinsics = self._cell.camera.intrinsics
            heightmap = self._projection.heightmap(frame.color, frame.depth, intrinsics, self.workspace)
            self._seen = Observation(heightmap, frame.color, self._projection.depth(frame.depth))
        return self._seen

    def execute(self, pick: Pick) -> Outcome:
        self._routes.home()
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
        routes, tool = self._routes, self._cell.tool
        bottom = max(pick.z - self.station.tool.depth, self.station.tool.floor_gap)
        place = pick.x, pick.y
        routes.to_gate()
        tool.prepare()
        routes.above(*place, pick.angle)
        if self._dry_run:
            routes.down(*place, min(max(pick.z + HOVER, bottom), self._clearance), pick.angle)
            return self._end_without("dry_run", 0.0)
        blocked = routes.down(*place, bottom, pick.angle, force_limit=self._contact_limit)
        tool.engage()
        engaged = tool.holds(tool.reading())
        routes.up(LIFT)
        time.sleep(HOLD_SECONDS)
        reading = tool.reading()
        if not tool.holds(reading):
            failed: Cause = "missed" if self.primitive == "grasp" else "no_seal"
            return self._end_without(
                "slipped" if engaged else "collision" if blocked and self.half_opening else failed, reading
            )
        routes.back_to_gate()
        routes.drop()
        tool.release()
        routes.to_gate()
        routes.home()
        return "ok", reading

    def _end_without(self, cause: Cause, reading: float) -> tuple[Cause, float]:
        """Go home with an empty tool."""
        self._routes.up()
        self._cell.tool.release()
        self._routes.back_to_gate()
        self._routes.home()
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
        self._routes.rise_and_go_home()

    @cached_property
    def _routes(self) -> Routes:
        """Made with the first motion, when the arm is connected."""
        routes = Routes(self._cell.arm, self.station, self._operator, self._clearance, *self._speeds)
        routes.refuse_out_of_reach()
        return routes

    @property
    def _cell(self) -> Cell:
        cell = connected(self._path, self.station, self._camera)
        self.station.demand_camera(cell.camera.serial)
        return cell


def _refuse_unfit(station: Station, workspace: Workspace, camera: DepthCamera, primitive: str) -> None:
    """Refuse what can be known without touching a device."""
    if not isinstance(camera, DepthCamera):
        raise RobotError("robot=ur5_real needs a real camera: add camera=realsense or camera=files")
    if station.primitive != primitive:
        raise RobotError(
            f"the station's {station.tool.kind} cannot do primitive={primitive}: use primitive={station.primitive}"
        )
    station.demand("home", "drop", "bin", "calibration", "background")
    width, length = station.bin_size()
    if workspace.width > width + 0.02 or workspace.length > length + 0.02:
        raise RobotError(
            f"workspace={workspace.name} is {workspace.width} by {workspace.length} m, and the taught bin {width:.3f} by "
            f"{length:.3f} m: choose a smaller one with workspace.width= and workspace.length=, or a larger bin"
        )
