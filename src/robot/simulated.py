"""A UR5 over a bin, simulated in PyBullet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from see2act.robot import heightmap as hm
from see2act.robot import urdf
from see2act.robot.arm import Arm, ArmConfig
from see2act.robot.camera import FAR, Camera
from see2act.robot.end_effector import EndEffector
from see2act.robot.layouts import Layout, Layouts, Refusal
from see2act.robot.objects import ObjectSet
from see2act.robot.robot import Robot
from see2act.robot.scene import BinConfig, Scene
from see2act.robot.simulation import TIMESTEP, Simulation
from see2act.robot.types import Cause, Heightmap, NotNegative, Observation, Outcome, Pick, RobotError, Split, Truth
from see2act.robot.workspace import Workspace
from see2act.seeding import generator

LIFT = 0.10
"""Metres (paper, section III-C)."""
HELD = 0.05
"""Metres that an object must have risen to count as truly held: half of the lift."""
HOLD_STEPS = 40
"""Timesteps to wait after the lift before the sensor is read; the hold must last that long."""
SPARE = 0.005
"""Metres between the end of the jump in a descent and the first thing that the tool could touch."""
REBUILDS = 20
"""Times that a scene is dropped before the robot gives up."""
MOTIONS = ("fast", "full")


@dataclass
class _Contact:
    """What the tool touched during a descent."""

    object: bool = False
    """Whether it touched any object."""
    wall: float = 0.0
    """Force of the bin's walls on the robot at the last check, newtons."""


class SimulatedRobot(Robot):
    """A UR5 over a bin in PyBullet.

    Args:
        workspace: Grid of the heightmap; the bin has the same size.
        camera: The RGB-D camera.
        objects: The objects that are dropped into the bin.
        end_effector: The tool, which determines the primitive.
        arm: Position and speeds of the arm.
        bin: Walls of the bin, and waiting times.
        clearance: World z of the tool's tip in metres where free motion ends and the descent begins.
        motion: ``full`` simulates every timestep. ``fast`` jumps where the tool cannot touch anything: between home and the
            point above a pick, and from there to just above the first thing under the tool. It also jumps on the way up with
            an empty tool, so nothing is dragged along there. ``robot_seconds`` includes the jumps.
        latency: Seconds until the robot reacts: a descent goes on for that long after its force was exceeded, and the tool
            takes hold that much after its command. Rounded to timesteps.
        video: Whether :meth:`film` records; a frame takes 0.1 s. It also loads the arm's visual meshes and shows the table.
        layouts: Folder for settled scenes of this configuration; None drops each scene again.

    Raises:
        RobotError: ``motion`` is unknown, the camera does not see the workspace, or the arm cannot reach home.
    """

    repeatable = True

    def __init__(
        self,
        workspace: Workspace,
        camera: Camera,
        objects: ObjectSet,
        end_effector: EndEffector,
        arm: ArmConfig,
        bin: BinConfig,
        clearance: NotNegative,
        motion: str,
        latency: Annotated[float, Ge(0), Le(1)] = 0.0,
        video: bool = False,
        layouts: str | None = None,
    ):
        if motion not in MOTIONS:
            raise RobotError(f"robot.motion={motion} is unknown: choose one of {', '.join(MOTIONS)}")
        floor = camera.floor_depth()
        if not len(hm.highest(hm.point_cloud(floor, camera.intrinsics, camera.pose), floor < FAR, workspace)[0]):
            raise RobotError(
                f"the camera at {camera.position} sees nothing of the bin: turn camera.target to it, less than {FAR} m away"
            )
        self.workspace = workspace
        self.primitive = end_effector.primitive
        self.half_opening = end_effector.half_opening
        self.camera = camera.cropped_to(_corners(workspace, clearance))
        """As it is known, for the projection of its images. In a scene it may be another: see :meth:`Camera.randomized`."""
        self._present_camera = self.camera
        self.tool = end_effector
        self._config = arm
        self._clearance = clearance
        self._latency_steps = round(latency / TIMESTEP)
        self._video = video
        self.simulation = Simulation()
        model = urdf.mount(urdf.ur5(), end_effector.urdf())
        self.arm = Arm(self.simulation, arm, model if video else urdf.without_visuals(model), jumps=motion == "fast")
        self.scene = Scene(self.simulation, bin, workspace.width, workspace.length, objects, table=video)
        self._layouts = Layouts(Path(layouts) if layouts else None)
        self._background: Heightmap | None = None
        self.rebuilds: Counter[Refusal] = Counter()
        """How often scenes were refused, by reason. A refused scene is dropped again from the next sub-seed."""

    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        layout = self._layouts.get(scene_seed, split, count)
        if layout is None:
            layout = self._drop(scene_seed, split, count)
            self._layouts.keep(layout, scene_seed, split, count)
        self.rebuilds.update(layout.refused)
        # A scene that has just settled is placed from its layout too. Otherwise it would differ from one that was kept, because
        # Bullet remembers the contacts of objects that settled, but has none for objects that are put back.
        self._put(layout, count)
        self.scene.paint_floor(generator("floor", scene_seed))
        self._mount()
        self._noise = generator("sensor", scene_seed)
        self._present_camera = self.camera.randomized(generator("randomization", scene_seed))

    def _drop(self, scene_seed: int, split: Split, count: int | None) -> Layout:
        """Drop objects until they form a valid scene. The arm is not loaded, so the scene is the same for every tool."""
        refused: list[Refusal] = []
        while len(refused) < REBUILDS:
            self.simulation.clear()
            self.scene.build()
            why = self.scene.drop(generator("scene", scene_seed, len(refused)), split, count)
            layout = self.scene.layout(tuple(refused))
            why = why or self._put(layout, count)
            if why is None:
                return layout
            refused.append(why)
        raise RobotError(
            f"scene {scene_seed} was dropped {REBUILDS} times and is still {refused[-1]}: "
            "raise robot.bin.settle_steps (restless), robot.bin.margin (spilled, scattered) or lower robot.bin.touching"
        )

    def _put(self, layout: Layout, count: int | None) -> Refusal | None:
        """Place a scene from its layout and let it rest, without the arm. Returns why the scene is not valid, or None."""
        self.simulation.clear()
        self.scene.build()
        return self.scene.place(layout, count)

    def background(self) -> Heightmap:
        """See :class:`Robot`. The image is taken once, without sensor noise.

        Nothing of it is randomized: it is of a day when the calibration was exact, and the light another one than today.
        """
        if self._background is None:
            self._build()
            color, depth, _ = self._look()
            self._background = self._heightmap(color, depth)
        return self._background

    def observe(self) -> Observation:
        color, depth, body = self._look()
        sensed = self._sensed(depth, body)
        return Observation(self._heightmap(color, sensed), color, sensed)

    def truth(self) -> Truth:
        """See :class:`Robot`. Without sensor noise, but with the errors of camera and depth scale that the scene has.

        So the labels fit what is observed, cell by cell. What is shifted are the picks.
        """
        color, depth, body = self._look()
        depth = depth * self._present_camera.depth_scale
        points = hm.point_cloud(depth, self.camera.intrinsics, self.camera.pose)
        heightmap = hm.project(color, depth, points, self.workspace)
        ids = np.where(np.isin(body, [b.id for b in self.scene.bodies]), body, -1)
        rows, cols, index = hm.highest(points, depth > 0, self.workspace)
        cells = np.full(self.workspace.shape, -1)
        cells[rows, cols] = ids.ravel()[index]
        source, known = hm.fill(heightmap.valid)
        return Truth(heightmap, np.where(known, cells[source], -1))

    def execute(self, pick: Pick) -> Outcome:
        arm, tool = self.arm, self.tool
        steps, seconds = self.simulation.steps, arm.seconds
        before = self.scene.positions()
        above, at = self._path(pick)
        down = arm.line(above, at, pick.angle, self._config.tool_speed)
        # The lift starts where the descent stopped, at most where it began. So it is enough to check this highest lift.
        up = arm.line(above, above + [0, 0, LIFT], pick.angle, self._config.tool_speed)
        if down is None or up is None:
            return Outcome(False, False, "unreachable", 0.0, 0.0, 0)
        tool.prepare()
        arm.move(down[0])
        contact = _Contact()
        free = self._room_below_tool()
        down = arm.enter(down, sum(above[2] - arm.position(joints)[2] < free for joints in down))
        blocked = arm.follow(down, until=self._late(lambda: self._note_contact(contact) > tool.contact_limit))
        stopped = blocked and contact.wall > tool.contact_limit / 2  # a protective stop: the arm withdraws immediately
        engaged = False
        if not stopped:
            arm.wait(self._latency_steps)
            tool.engage()
            engaged = tool.engaged()
            self._note_contact(contact)
        self._lift(pick, engaged)
        reading, success = (0.0, False) if stopped else tool.sense()
        held = self._held(before)
        cause: Cause = "missed"
        if success or stopped:
            cause = "ok" if success else "wall"
        elif contact.object:
            cause = tool.why_failed(engaged, blocked)
        tool.release()
        if success:
            self.scene.remove(held)
        arm.home()
        if success or contact.object or self._moved(before):
            self.scene.settle()
        lost = self.scene.clear_lost()
        if lost:
            self.scene.settle()  # objects that leaned on it may fall
        return Outcome(success, bool(held), cause, reading, arm.seconds - seconds, self.simulation.steps - steps, lost)

    def bin_empty(self) -> bool:
        return not self.scene.bodies

    def close(self) -> None:
        self.simulation.close()

    def film(self, path: Path) -> AbstractContextManager[None]:
        if not self._video:
            return nullcontext()
        from see2act.robot.video import film  # imported late: FFmpeg is large and rarely needed

        return film(self.simulation, path)

    def _build(self) -> None:
        """Load the empty bin and the arm, with the camera as it is known."""
        self._present_camera = self.camera
        self.simulation.clear()
        self.scene.build()
        self._mount()

    def _mount(self) -> None:
        self.arm.load()
        self.tool.bind(self.simulation, self.arm)

    def _look(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render the bin without the table and without the arm, which a real set-up would move out of view."""
        with self.simulation.hidden(self.arm.body, self.scene.table):
            return self._present_camera.render(self.simulation)

    def _sensed(self, depth: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Depth as the scene's camera measures it."""
        glass = np.isin(body, [b.id for b in self.scene.bodies if b.transparent])
        return self._present_camera.sense(depth, glass, self._noise)

    def _heightmap(self, color: np.ndarray, depth: np.ndarray) -> Heightmap:
        points = hm.point_cloud(depth, self.camera.intrinsics, self.camera.pose)
        return hm.project(color, depth, points, self.workspace)

    def _path(self, pick: Pick) -> tuple[np.ndarray, np.ndarray]:
        """World positions of ``tool0`` above the pick and at it."""
        z = float(self.tool.depth_at(np.array(pick.z))) + self.tool.length()
        above = max(self._clearance + self.tool.length(), z)
        return np.array([pick.x, pick.y, above]), np.array([pick.x, pick.y, z])

    def _late(self, condition: Callable[[], bool]) -> Callable[[], bool]:
        """Whether a condition held for the first time at least the latency ago. It is asked once every timestep."""
        steps = 0  # since then

        def noticed() -> bool:
            nonlocal steps
            holds = condition()
            steps += holds or steps > 0
            return steps > self._latency_steps

        return noticed

    def _lift(self, pick: Pick, engaged: bool) -> None:
        start = self.arm.commanded_position
        up = self.arm.line(start, start + [0, 0, LIFT], pick.angle, self._config.tool_speed)
        assert up is not None, "execute() has checked the highest lift, and the arm reaches all below"

        if self.arm.jumps and not engaged:
            self.arm.travel(up)
            self.arm.seconds += HOLD_STEPS * TIMESTEP
            return

        def tend() -> bool:
            self.tool.update_hold()
            return False

        self.arm.follow(up, until=tend)
        self.arm.wait(HOLD_STEPS, until=tend)

    def _room_below_tool(self) -> float:
        """Metres that the tool can move straight down before it may touch anything; negative if it may touch something now."""
        box = self.simulation.client.getAABB
        fixed = (self.scene.table, self.scene.floor, *self.scene.walls)
        below = np.array([box(body) for body in (*fixed, *(body.id for body in self.scene.bodies))])
        room = np.inf
        for low, high in (np.array(box(self.arm.body, link)) for link in self.arm.tool_links):
            apart = (below[:, 1, :2] < low[:2]) | (below[:, 0, :2] > high[:2])
            room = min(room, *(low[2] - below[~apart.any(axis=1), 1, 2]), np.inf)
        return float(room) - SPARE

    def _moved(self, before: dict[int, np.ndarray]) -> bool:
        """Whether any object has moved. The position of a sleeping object does not change by a single bit."""
        return any(not np.array_equal(at, before[body]) for body, at in self.scene.positions().items())

    def _note_contact(self, contact: _Contact) -> float:
        """Contact force on the robot in newtons; also updates ``contact``."""
        points = self.simulation.client.getContactPoints(bodyA=self.arm.body)
        objects = {body.id for body in self.scene.bodies}
        contact.object |= any(point[2] in objects and point[9] > 0 for point in points)
        contact.wall = float(sum(point[9] for point in points if point[2] in self.scene.walls))
        return float(sum(point[9] for point in points))

    def _held(self, before: dict[int, np.ndarray]) -> set[int]:
        """Objects that rose with the tool, are within 5 mm of it, and do not touch the bin."""
        client = self.simulation.client
        held = set()
        for body, position in self.scene.positions().items():
            risen = position[2] - before[body][2] > HELD
            if not risen or not client.getClosestPoints(self.arm.body, body, 0.005):
                continue
            if not any(client.getContactPoints(body, b) for b in (self.scene.floor, *self.scene.walls)):
                held.add(body)
        return held


def _corners(workspace: Workspace, height: float) -> np.ndarray:
    """Corners (8, 3) of the box over the bin's floor up to ``height`` metres."""
    x, y = workspace.width / 2, workspace.length / 2
    return np.array([(i, j, k) for i in (-x, x) for j in (-y, y) for k in (0, height)])
