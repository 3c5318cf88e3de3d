"""A whole station without hardware: the simulated scene behind a stand-in for the controller, and a camera that writes files.

`python -m benchmarks.stand_in FOLDER` keeps one up, for trying a run of a real robot by hand.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from benchmarks.stand_in.board import with_board
from benchmarks.stand_in.controller import Controller
from benchmarks.stand_in.tools import stand_in_for
from see2act.experiment.build import robot_factory
from see2act.experiment.config import composed
from see2act.robot.arm import HOME_ANGLE, JOINTS, pointing_down
from see2act.robot.real import station as stations
from see2act.robot.real.board import Board
from see2act.robot.real.image_folder import Description, describe, write_pair
from see2act.robot.real.projection import CENTRE
from see2act.robot.real.station import CalibrationSection, RobotSection, Station, TouchSection
from see2act.robot.real.views import bin_points
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.simulation import TIMESTEP
from see2act.robot.types import Split

SERIAL = "stand-in"
FASTEST = 10.0
"""Times that the simulation runs faster than real time, at most."""
SHOT_EVERY = 0.15
"""Seconds of real time between images while the arm is at rest."""
REST = 240
"""Timesteps without motion of arm and tool, a second, after which nothing is simulated until something happens."""
KEPT = 20
"""Images in the folder."""
CORNERS = {"near left": (-1.0, 1.0, 0.0), "near right": (-1.0, -1.0, 0.0), "far left": (1.0, 1.0, 0.0)}
PLACES = {"home": (0.0, 0.0, 0.0), "drop": (0.0, 0.0, 0.0), **CORNERS, "board": (-0.05, 0.0, 0.15)}
"""Where a hand leads the tip: shares of half the bin, and metres above its floor. Home and the drop are known by joints."""
BOARD = Board()
BRACKET = (0.08, 0.0, 0.10)
"""Middle of the board in the frame of the flange, metres."""
LYING = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""A board's pose in the world, in the middle of the bin, its printed side up."""
DROP = (1.2, -1.3, 1.4, -1.67, -1.57, 0.0)
"""Joints beside the bin, radians."""


class StandInCell:
    """A station in a process of its own.

    Args:
        host: Address of its controller, 127.0.0.N.
        folder: Where ``station.yaml``, the image of the empty bin and the camera's images go.
        overrides: Configuration of the simulated robot, as for train.py.
        unboxed: Whether the station is not set up yet: there is no ``station.yaml``, and the camera shows more than the bin.
    """

    def __init__(self, host: str, folder: Path, overrides: Sequence[str] = (), unboxed: bool = False):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = host, folder, list(overrides), unboxed, theirs
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        self.tool: stations.Tool = self._pipe.recv()
        """What a station's file says of the tool."""

    def fill(self, scene_seed: int, split: Split) -> None:
        """What a person does when asked for a scene."""
        self._ask("fill", scene_seed, split)

    def empty(self) -> None:
        """Take everything out of the bin."""
        self._ask("empty")

    def lead(self, place: str) -> None:
        """What a hand does in freedrive: lead the arm to a key of :data:`PLACES`.

        Raises:
            ValueError: Nothing has asked for freedrive.
        """
        self._ask("lead", place)

    def put_board(self, place: Literal["away", "tool", "floor"]) -> None:
        """Fix the calibration board beside the tool, lay it into the bin, or take it away."""
        self._ask("put_board", place)

    def offset(self) -> tuple[float, float]:
        """What a person measures: metres from the tip to the next corner of the board in the bin, sideways and up."""
        sideways, up = self._ask("offset")
        return sideways, up

    def error(self, camera: Float[np.ndarray, "4 4"]) -> float:
        """Metres rms by which points in the bin are off with a camera in this pose (to the controller's base)."""
        found: float = self._ask("error", camera)
        return found

    def protective_stop(self) -> None:
        """Stop the arm, as a collision would."""
        self._ask("protective_stop")

    def unlock(self) -> None:
        """What a person does at the pendant afterwards."""
        self._ask("unlock")

    def moves(self) -> int:
        """Motions commanded so far."""
        count: int = self._ask("moves")
        return count

    def moving(self) -> bool:
        """Whether a motion is under way."""
        return bool(self._ask("moving"))

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _ask(self, what: str, *arguments: object) -> Any:
        self._pipe.send((what, arguments))
        answer = self._pipe.recv()
        if isinstance(answer, ValueError):
            raise answer
        return answer


class _Cell:
    """What runs in that process: joints that the controller commands, and a tool that its outputs switch."""

    def __init__(self, host: str, folder: Path, overrides: list[str], unboxed: bool):
        large = ["camera.width=1280", "camera.height=720", "camera.focal=930"] if unboxed else []
        cfg = composed(["task=none", "transfer=none", *large, *overrides, "robot.motion=full"])
        robot: SimulatedRobot = robot_factory(cfg, cfg.primitive)()
        self.robot, self._folder = robot, folder
        if unboxed:  # all of its image, at the sensor's resolution: markers are small
            robot.camera = replace(robot.camera, crop=None)
        robot.background()  # builds the empty bin and the arm
        self.controller = Controller(host)
        self.controller.state.q = np.array(self._joints())
        self.tool = stand_in_for(robot.tool, self.controller.state, host)
        self._steps, self._busy_until, self._shots, self._next_shot = 0, REST, 0, 0.0
        self._home = self._joints()
        self._world = np.diag([-1.0, -1.0, 1.0, 1.0])  # to the controller's base, which is turned by half a turn
        self._world[:3, 3] = np.array([1, 1, -1]) * robot._config.base
        self._board: Float[np.ndarray, "4 4"] | None = None
        self._board_carried = False
        self._view: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._describe_camera()
        if not unboxed:
            self._write_station(host)
        robot._noise = np.random.default_rng(0)

    def answer(self, what: str, arguments: tuple) -> Any:
        if what == "fill":
            self.robot.reset(*arguments)
            self.tool.reset()
            self._busy_until = self._steps + REST
            self.controller.state.q = np.array(self._joints())
            return None
        if what == "unlock":
            self.controller.state.safety_mode = 1
            return None
        if what == "moves":
            return sum(entry in ("command 1", "command 3") for entry in self.controller.log)
        if what in ("empty", "lead", "put_board", "offset", "error"):
            return getattr(self, what)(*arguments)
        found = getattr(self.controller, what)
        return found() if callable(found) else found

    def empty(self) -> None:
        self.robot._build()
        self._view = None
        self._busy_until = self._steps + REST

    def lead(self, place: str) -> None:
        state = self.controller.state
        if not state.freedrive:
            raise ValueError("the arm does not give way to a hand: nothing has asked for that")
        state.q = self._joints_at(place)
        self.robot.arm.teleport(state.q)  # on a free way, which a hand finds

    def _joints_at(self, place: str) -> np.ndarray:
        if place in ("home", "drop"):
            return np.array(self._home if place == "home" else DROP)
        corner = np.array(PLACES[place]) * [self.robot.workspace.width / 2, self.robot.workspace.length / 2, 1]
        tip = np.eye(4)
        tip[:3, :3], tip[:3, 3] = pointing_down(HOME_ANGLE + np.pi), corner
        joints = self.controller.joints_at(np.array(stations.pose(self._world @ tip)), np.array(self._home))
        assert joints is not None
        return joints

    def put_board(self, place: str) -> None:
        """The board is seen face on where it is in the tool and the arm at :data:`PLACES` ``board``."""
        self._board_carried = place == "tool"
        self._board = None
        if place == "floor":
            self._board = LYING @ _moved(-BOARD.corners().mean(0))
        elif place == "tool":
            flange = np.eye(4)
            flange[:3, :3] = pointing_down(HOME_ANGLE + np.pi)
            facing = np.eye(4)
            facing[:3, :3] = flange[:3, :3].T @ self.robot.camera.pose[:3, :3]
            facing[:3, 3] = BRACKET
            self._board = facing @ _moved(-BOARD.corners().mean(0))

    def offset(self) -> tuple[float, float]:
        if self._board is None or self._board_carried:
            raise ValueError("no board lies in the bin")
        corners = BOARD.corners() @ self._board[:3, :3].T + self._board[:3, 3]
        away = self._tip()[:3, 3] - corners
        nearest = away[np.argmin(np.linalg.norm(away[:, :2], axis=1))]
        return float(np.linalg.norm(nearest[:2])), float(nearest[2])

    def error(self, camera: Float[np.ndarray, "4 4"]) -> float:
        points = bin_points(self._world, (self.robot.workspace.width, self.robot.workspace.length))
        true = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(self._world @ self.robot.camera.pose).T
        return float(np.sqrt((((true @ camera.T)[:, :3] - points) ** 2).sum(1).mean()))

    def step(self) -> None:
        """One timestep of everything that is not at rest, and an image when it is time for one."""
        if self.controller.moving or self.tool.active:
            self._busy_until = self._steps + REST
        if self._steps < self._busy_until:
            self._simulate()
        now = time.monotonic()
        if not self.controller.moving and now >= self._next_shot:
            self._shoot()
            self._next_shot = now + SHOT_EVERY

    def _simulate(self) -> None:
        robot, state = self.robot, self.controller.state
        self.controller.step(TIMESTEP)
        robot.arm._command(state.q, np.zeros(6))
        robot.simulation.step()
        self._steps += 1
        if self.tool.step(at_rest=not self.controller.moving):
            robot.scene.settle()
            robot.scene.clear_lost()
        points = robot.simulation.client.getContactPoints(bodyA=robot.arm.body)
        state.force = [0.0, 0.0, float(sum(point[9] for point in points)), 0.0, 0.0, 0.0]

    def _shoot(self) -> None:
        """An image with the sensor's noise, without the arm in it: at home it is out of view."""
        if self._view is None or self.robot.scene.bodies:
            self._view = self.robot._look()  # an empty bin always looks the same
        color, depth, body = self._view
        camera = self.robot._present_camera
        if self._board is not None:
            carrier = np.eye(4)
            if self._board_carried:
                carrier = self._tip() @ np.linalg.inv(stations.matrix(self.controller.state.tcp))
            pose = np.linalg.inv(camera.pose) @ carrier @ self._board
            color, depth = with_board(color, depth, BOARD, pose, camera.intrinsics - CENTRE)
        write_pair(self._folder / "camera", f"{self._shots:06}", color, self.robot._sensed(depth, body), 1e-4)
        self._shots += 1
        for old in (self._folder / "camera").glob(f"{self._shots - KEPT:06}.*"):
            old.unlink()

    def _tip(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the tool's tip in the world."""
        return np.linalg.inv(self._world) @ stations.matrix(self.controller.tip())

    def _joints(self) -> stations.Joints:
        arm = self.robot.arm
        states = self.robot.simulation.client.getJointStates(arm.body, [arm.joint_index[name] for name in JOINTS])
        return tuple(float(state[0]) for state in states)  # type: ignore[return-value]

    def _describe_camera(self) -> None:
        camera = self.robot.camera
        (rows, cols), intrinsics = camera.shape, camera.intrinsics - CENTRE
        describe(
            self._folder / "camera",
            Description(
                serial=SERIAL,
                width=cols,
                height=rows,
                fx=camera.focal,
                fy=camera.focal,
                cx=intrinsics[0, 2],
                cy=intrinsics[1, 2],
                depth_scale=1e-4,
            ),
        )

    def _write_station(self, host: str) -> None:
        robot, camera = self.robot, self.robot.camera
        rows, cols = camera.shape
        color, depth, _ = robot._look()
        background = {"color": color, "depth": depth, "intrinsics": camera.intrinsics - CENTRE}
        np.savez_compressed(self._folder / "background.npz", allow_pickle=False, **background)
        x, y = robot.workspace.width / 2, robot.workspace.length / 2
        corners: list[stations.Point] = [tuple(self._world @ [x * i, y * j, 0, 1])[:3] for i, j, _ in CORNERS.values()]
        calibration = CalibrationSection(
            serial=SERIAL,
            size=(cols, rows),
            camera=(self._world @ camera.pose).tolist(),
            error=0.0,
            views=25,
            date="2026-01-01",
        )
        stations.save(
            Station(
                robot=RobotSection(host=host, home=self._joints(), drop=DROP),
                tool=self.tool.section,
                bin=(corners[0], corners[1], corners[2]),
                calibration=calibration,
                touch=TouchSection(offset=0.0, serial=SERIAL, date="2026-01-01"),
                background="background.npz",
            ),
            self._folder / "station.yaml",
        )


def _moved(by: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, 3] = by
    return pose


def _serve(host: str, folder: Path, overrides: list[str], unboxed: bool, pipe: Connection) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    cell = _Cell(host, folder, overrides, unboxed)
    pipe.send(cell.tool.section)
    last, behind = time.monotonic(), 0.0
    while True:
        now = time.monotonic()
        behind = min(behind + FASTEST * (now - last), 0.1)  # simulated time that is due
        last = now
        while behind > 0:
            cell.step()
            behind -= TIMESTEP
        while pipe.poll():
            try:
                what, arguments = pipe.recv()
            except EOFError:
                return
            try:
                pipe.send(cell.answer(what, arguments))
            except ValueError as error:
                pipe.send(error)
        time.sleep(0.002)
