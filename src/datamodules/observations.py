"""Observations of random interaction with a robot whose bin a person fills: kept in a folder, for all later runs."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from see2act.attempt import attempt
from see2act.datamodules.collect import Collection
from see2act.datamodules.records import MAPS, Records, collecting
from see2act.errors import ConfigError
from see2act.files import read_arrays, read_json, write_arrays, write_json
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap
from see2act.robot.workspace import Workspace
from see2act.seeding import generator, seed_for

SIDES = ("width", "length", "pixel")
"""What two workspaces must share for their heightmaps to have the same grid."""


@dataclass(frozen=True)
class Observations:
    """A folder with an interaction a file, in the order in which they were made.

    ``background.npz`` has the empty bin, and ``grid.json`` says what grid the heightmaps have, and with which primitive the
    folder was begun.

    Args:
        folder: Made with the first interaction.
    """

    folder: Path

    def __len__(self) -> int:
        return len(self._names())

    def check(self, workspace: Workspace) -> None:
        """Refuse a folder whose heightmaps have another grid.

        Raises:
            ConfigError: It is of another workspace.
        """
        if not self._grid.exists():
            return
        grid = read_json(self._grid)
        if other := [side for side in SIDES if not math.isclose(grid[side], getattr(workspace, side))]:
            theirs = ", ".join(f"workspace.{side}={grid[side]}" for side in other)
            raise ConfigError(
                f"{self.folder} holds observations with {theirs}, not those of workspace={workspace.name}: choose another "
                "collect.folder=, or the workspace that they were made with"
            )

    def scenes_left(self, interactions: int, per_scene: int) -> int:
        """Scenes that are needed until there are ``interactions``, if the one under way goes on."""
        _, made = self._last_scene()
        under_way = per_scene - made if 0 < made < per_scene else 0
        return math.ceil(max(0, interactions - len(self) - under_way) / per_scene)

    def first(self, count: int) -> Collection:
        """The first ``count`` of them. What is really in the bin nobody knows, so the truth is what was sensed."""
        maps = [self._records.read(name).heightmap for name in self._names()[:count]]
        sensed = {key: np.stack([getattr(heightmap, key) for heightmap in maps]) for key in MAPS}
        clean = {f"clean_{key}": values for key, values in sensed.items()}
        body = np.full(sensed["height"].shape, -1, np.int32)
        background = read_arrays(self._background, MAPS)
        return Collection({**sensed, **clean, "body": body}, Heightmap(*(background[key] for key in MAPS)))

    def digest(self, count: int) -> str:
        """Hexadecimal digits that depend on nothing but what :meth:`first` reads."""
        digest = hashlib.sha256(self._background.read_bytes())
        for name in self._names()[:count]:
            digest.update((self.folder / f"{name}.npz").read_bytes())
        return digest.hexdigest()

    def add(
        self, robot: Robot, interactions: int, per_scene: int, most_objects: int, seed: int, policy: Policy, angles: int
    ) -> None:
        """Interact at random until there are ``interactions``, in the scene that is under way and in new ones.

        Args:
            robot: Interacts.
            interactions: Number of observations that there will be.
            per_scene: Picks after which the bin is refilled.
            most_objects: Number of objects in a full bin; scenes have a random number of them, so that nearly empty bins are
                included.
            seed: Seed of scenes and picks.
            policy: Says where the tool has room.
            angles: Number of angles that a pick may have.
        """
        if not self._background.exists():
            empty = robot.background()
            write_arrays(self._background, {key: getattr(empty, key) for key in MAPS})
        if not self._grid.exists():
            write_json(self._grid, {side: getattr(robot.workspace, side) for side in SIDES} | {"primitive": robot.primitive})
        equal = np.zeros((angles, *robot.workspace.shape), np.float32)
        scene, made = self._last_scene()
        goes_on = 0 < made < per_scene and robot.resume(_scene_seed(seed, scene), made)
        for _ in tqdm(range(len(self), interactions), desc="collect", disable=None):
            if not goes_on:
                scene, made = scene + 1, 0
                objects = int(generator("collect", seed, scene).integers(1, most_objects + 1))
                robot.reset(_scene_seed(seed, scene), "seen", objects)
            rng = generator("collect/pick", seed, scene, made)
            done = attempt(robot, lambda color, height: equal, policy, temperature=1.0, rng=rng)
            self._records.save(collecting(scene, made), done)
            made += 1
            goes_on = made < per_scene

    @property
    def _records(self) -> Records:
        return Records(self.folder)

    @property
    def _grid(self) -> Path:
        return self.folder / "grid.json"

    @property
    def _background(self) -> Path:
        return self.folder / "background.npz"

    def _names(self) -> list[str]:
        return sorted(path.stem for path in self.folder.glob("scene-*.npz"))

    def _last_scene(self) -> tuple[int, int]:
        """Number of the scene that was begun last, from 0, and interactions in it; (-1, 0) before the first."""
        names = self._names()
        scenes = [int(name.split("-")[1]) for name in names]
        return (scenes[-1], scenes.count(scenes[-1])) if scenes else (-1, 0)


def _scene_seed(seed: int, scene: int) -> int:
    return seed_for("scene/collect", seed, scene)
