"""Collecting observations while the robot interacts at random with the bin (paper: random interaction)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from tqdm import tqdm

from see2act.datamodules.labels import View
from see2act.datamodules.workers import end_with_parent
from see2act.files import read_arrays, write_arrays
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap
from see2act.seeding import generator, seed_for

RobotFactory = Callable[[], Robot]
SCENES_IN_A_ROW = 3
"""Scenes that a worker process collects in a row with one robot."""
ARRAYS = ("color", "height", "valid", "clean_color", "clean_height", "clean_valid", "body")
BACKGROUND = ("background_color", "background_height", "background_valid")


@dataclass(frozen=True)
class Collection:
    """n observations of random interaction, each with the simulator's truth."""

    arrays: dict[str, np.ndarray]
    background: Heightmap

    def __len__(self) -> int:
        return len(self.arrays["color"])

    def view(self, i: int) -> View:
        """Observation ``i``, for labelling."""
        a = self.arrays
        return View(
            sensed=Heightmap(a["color"][i], a["height"][i], a["valid"][i]),
            clean=Heightmap(a["clean_color"][i], a["clean_height"][i], a["clean_valid"][i]),
            body=a["body"][i].astype(int),
            background=self.background,
        )

    def last(self, count: int) -> Collection:
        """The last ``count`` observations."""
        return Collection({name: values[-count:] for name, values in self.arrays.items()}, self.background)

    def save(self, path: Path) -> None:
        """Write atomically."""
        empty = (self.background.color, self.background.height, self.background.valid)
        write_arrays(path, self.arrays | dict(zip(BACKGROUND, empty, strict=True)))

    @classmethod
    def load(cls, path: Path) -> Collection:
        """Read what :meth:`save` wrote.

        Raises:
            DamagedFile: It is no such file.
        """
        content = read_arrays(path, (*ARRAYS, *BACKGROUND))
        return cls({name: content[name] for name in ARRAYS}, Heightmap(*(content[name] for name in BACKGROUND)))


def collect(
    make_robot: RobotFactory, interactions: int, per_scene: int, most_objects: int, seed: int, workers: int
) -> Collection:
    """Collect observations between random picks on seen objects.

    Scenes have a random number of objects, from one to all, so that nearly empty bins are included. The result does not
    depend on ``workers``, because the seed and the number of a scene determine everything in it.

    Args:
        make_robot: Builds a robot. It runs in worker processes, so it must be picklable.
        interactions: Number of observations.
        per_scene: Picks after which the bin is refilled.
        most_objects: Number of objects in a full bin.
        seed: Seed of scenes and picks.
        workers: Number of processes.
    """
    counts = [min(per_scene, interactions - done) for done in range(0, interactions, per_scene)]
    scenes = list(enumerate(counts))
    tasks = [
        delayed(_scenes)(make_robot, seed, scenes[i : i + SCENES_IN_A_ROW], most_objects)
        for i in range(0, len(scenes), SCENES_IN_A_ROW)
    ]
    parts: list[Collection] = []
    with tqdm(total=interactions, desc="collect", disable=None) as bar:
        for done in Parallel(workers, backend="loky", return_as="generator", initializer=end_with_parent)(tasks):
            parts += done
            bar.update(sum(len(part) for part in done))
    arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in ARRAYS}
    return Collection(arrays, parts[0].background)


def _scenes(make_robot: RobotFactory, seed: int, scenes: list[tuple[int, int]], most_objects: int) -> list[Collection]:
    robot = make_robot()
    try:
        return [_scene(robot, seed, scene, interactions, most_objects) for scene, interactions in scenes]
    finally:
        robot.close()


def _scene(robot: Robot, seed: int, scene: int, interactions: int, most_objects: int) -> Collection:
    rng = generator("collect", seed, scene)
    background = robot.background()
    count = int(rng.integers(1, most_objects + 1))
    robot.reset(seed_for("scene/collect", seed, scene), "seen", count)
    rows, cols = robot.workspace.shape
    records = []
    for _ in range(interactions):
        observation, truth = robot.observe(), robot.truth()
        sensed, clean = observation.heightmap, truth.heightmap
        records.append(
            (sensed.color, sensed.height, sensed.valid, clean.color, clean.height, clean.valid, truth.body.astype(np.int32))
        )
        angle = rng.integers(16) * np.pi / 16
        robot.execute(robot.workspace.pick(sensed, int(rng.integers(rows)), int(rng.integers(cols)), float(angle)))
    arrays = {name: np.stack(values) for name, values in zip(ARRAYS, zip(*records, strict=True), strict=True)}
    return Collection(arrays, background)
