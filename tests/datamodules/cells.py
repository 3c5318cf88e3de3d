"""A robot for tests of trial and error. Its module imports little, since each robot's process imports it anew."""

from __future__ import annotations

import os

import numpy as np

from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick, RobotError
from see2act.robot.workspace import Workspace
from see2act.seeding import generator

WORKSPACE = Workspace("bin", 0.02, 0.02, 0.0025)
SIDE = 8


class Cells(Robot):
    """A bin of eight by eight cells, three of them full. What it shows has noise, and a pick changes what it will show."""

    workspace = WORKSPACE
    primitive = "suction"
    repeatable = True

    def background(self) -> Heightmap:
        raise NotImplementedError

    def reset(self, scene_seed: int, split: str, count: int | None = None) -> None:
        rng = generator("cells", scene_seed)
        self._full = set(rng.choice(SIDE * SIDE, 3, replace=False).tolist())
        self._noise = generator("noise", scene_seed)

    def observe(self) -> Observation:
        height = self._noise.normal(0, 0.001, SIDE * SIDE).astype(np.float32)
        height[list(self._full)] += 0.03
        height = height.reshape(SIDE, SIDE)
        heightmap = Heightmap(np.zeros((SIDE, SIDE, 3), np.uint8), height, np.ones((SIDE, SIDE), bool))
        return Observation(heightmap, heightmap.color, height)

    def execute(self, pick: Pick) -> Outcome:
        if pick.row == pick.col == 7:
            raise RobotError("it is out of order")
        cell = pick.row * SIDE + pick.col
        held = cell in self._full
        self._full.discard(cell)
        return Outcome(held, held, "ok" if held else "missed", 0.0, 1.0, 1)

    def bin_empty(self) -> bool:
        return not self._full

    def process(self) -> int:
        return os.getpid()

    def close(self) -> None:
        pass
