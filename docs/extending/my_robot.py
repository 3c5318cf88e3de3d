"""A robot without an arm: discs on a table, seen from above. A pick succeeds on the inner half of the topmost disc.

A real robot is written alike: ``observe`` asks its camera, ``execute`` moves its arm and reads its sensor.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick, Split, Truth
from see2act.robot.workspace import Workspace
from see2act.seeding import generator

RADII: dict[Split, tuple[float, float]] = {"seen": (0.02, 0.04), "unseen": (0.025, 0.05)}
"""Metres, by split: smallest and largest."""
FLOOR = (90, 90, 95)


@dataclass
class Disc:
    x: float
    y: float
    radius: float
    height: float
    color: tuple[int, ...]


class Discs(Robot):
    """Implements what :class:`see2act.robot.robot.Robot` promises.

    Args:
        workspace: The heightmap's grid.
        noise: Metres of the sensor's standard deviation.
        camera, objects, end_effector: Given to every robot; the tool's name is all that is used here.
    """

    repeatable = True  # a simulation without chance but that of its seed

    def __init__(self, workspace: Workspace, noise: float, camera: Any, objects: Any, end_effector: Any):
        self.workspace, self.primitive = workspace, end_effector.primitive
        self._noise = noise
        self._discs: list[Disc] = []
        rows, cols = np.indices(workspace.shape)
        self._x, self._y = workspace.to_world(rows, cols)

    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        rng = generator("scene", scene_seed)
        reach = self.workspace.width / 2 - 0.05
        self._discs = [
            Disc(*rng.uniform(-reach, reach, 2), rng.uniform(*RADII[split]), 0.03 + 0.005 * k, tuple(rng.integers(256, size=3)))
            for k in range(8)
        ][:count]
        self._sensor = generator("sensor", scene_seed)

    def background(self) -> Heightmap:
        self._discs = []
        return self.truth().heightmap

    def observe(self) -> Observation:
        exact = self.truth().heightmap
        noise = self._sensor.normal(0, self._noise, exact.height.shape).astype(np.float32)
        seen = Heightmap(exact.color, exact.height + noise, exact.valid)
        return Observation(seen, exact.color, 1 - seen.height)  # the camera hangs a metre above the table

    def truth(self) -> Truth:
        body = self._topmost()
        heights = np.array([0.0, *(disc.height for disc in self._discs)], np.float32)
        colors = np.array([FLOOR, *(disc.color for disc in self._discs)], np.uint8)
        return Truth(Heightmap(colors[body + 1], heights[body + 1], np.ones(body.shape, bool)), body)

    def execute(self, pick: Pick) -> Outcome:
        hit = int(self._topmost()[pick.row, pick.col])
        good = hit >= 0 and np.hypot(pick.x - self._discs[hit].x, pick.y - self._discs[hit].y) < self._discs[hit].radius / 2
        if good:
            del self._discs[hit]
        cause = "ok" if good else "missed" if hit < 0 else "no_seal"
        return Outcome(bool(good), bool(good), cause, float(good), 5.0, 0)

    def bin_empty(self) -> bool:
        return not self._discs

    def close(self) -> None:
        pass

    def _topmost(self) -> np.ndarray:
        """Index of the highest disc at each pixel, -1 where there is none."""
        body = np.full(self.workspace.shape, -1)
        for index, disc in enumerate(self._discs):  # each is higher than those before it
            body[np.hypot(self._x - disc.x, self._y - disc.y) < disc.radius] = index
        return body
