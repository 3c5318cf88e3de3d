"""A robot whose bin a person fills, and the configuration of its runs: small, and quick."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from omegaconf import DictConfig

from see2act.experiment.config import composed
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick, Split
from see2act.robot.workspace import Workspace
from see2act.seeding import generator
from tests.jobs import TINY

SIDE = 8
"""Pixels of a block."""


class Killed(Exception):
    """In place of a signal, which would end the tests, too."""


class Table(Robot):
    """Blocks on a table, seen from above; a pick in the middle of one takes it away.

    What is on the table is there for every robot that is built, also after the program was killed: the class has it.
    """

    attended = True
    calls: ClassVar[list[str]] = []
    """What was asked of the person, and picks."""
    blocks: ClassVar[list[tuple[int, int]]] = []
    """Row and column of each."""
    as_it_was: ClassVar[bool] = True
    """What the person answers."""
    slippery: ClassVar[bool] = False
    """Whether every pick fails."""
    killed_in: ClassVar[int] = -1
    """Picks until the program is killed in one; -1 for never."""

    def __init__(self, workspace: Workspace, camera: Any, objects: Any, end_effector: Any):
        self.workspace, self.primitive = workspace, end_effector.primitive

    @classmethod
    def prepare(cls) -> None:
        """An empty table, and nothing done yet."""
        cls.calls, cls.blocks, cls.as_it_was, cls.slippery, cls.killed_in = [], [], True, False, -1

    @classmethod
    def count(cls, call: str) -> int:
        """How often something was asked."""
        return sum(each.startswith(call) for each in cls.calls)

    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        self.calls.append(f"fill {split}")
        rng, most = generator("table", scene_seed), self.workspace.shape[0] - SIDE
        self.blocks[:] = [(int(rng.integers(most)), int(rng.integers(most))) for _ in range(count or 5)]

    def resume(self, scene_seed: int, attempts: int) -> bool:
        self.calls.append(f"resume after {attempts}")
        return self.as_it_was

    def background(self) -> Heightmap:
        return self._seen([])

    def observe(self) -> Observation:
        seen = self._seen(self.blocks)
        return Observation(seen, seen.color, 1 - seen.height)

    def execute(self, pick: Pick) -> Outcome:
        if self.killed_in == 0:
            raise Killed
        type(self).killed_in -= 1
        self.calls.append(f"pick {pick.row} {pick.col}")
        hit = next((b for b in self.blocks if all(2 <= at < SIDE - 2 for at in (pick.row - b[0], pick.col - b[1]))), None)
        held = hit is not None and not self.slippery
        if hit and held:
            self.blocks.remove(hit)
        return Outcome(held, None, "ok" if held else "no_seal", float(held), 2.0, 0)

    def bin_empty(self) -> bool:
        return not self.blocks

    def close(self) -> None:
        pass

    def _seen(self, blocks: list[tuple[int, int]]) -> Heightmap:
        height = np.zeros(self.workspace.shape, np.float32)
        for row, col in blocks:
            height[row : row + SIDE, col : col + SIDE] = 0.03
        color = np.where(height[..., None] > 0, np.uint8([200, 60, 40]), np.uint8([90, 90, 95]))
        return Heightmap(color, height, np.ones(height.shape, bool))


def configured(*overrides: str) -> DictConfig:
    """Of a run with this robot."""
    robot = ("~robot", f"+robot={{_target_: {__name__}.Table}}")
    small = ("workspace.width=0.12", "workspace.length=0.12", "model.width=4")
    few = ("evaluate.attempts.seen=3", "evaluate.attempts.unseen=3", "collect.per_scene=4", "logger=none")
    return composed([*TINY, *robot, *small, *few, *overrides])
