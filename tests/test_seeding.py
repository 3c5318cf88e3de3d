from __future__ import annotations

import numpy as np

from see2act.datamodules.collect import _scenes
from see2act.experiment.evaluation import scene_seed
from see2act.experiment.results import SPLITS
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick
from see2act.robot.workspace import Workspace
from see2act.seeding import generator, seed_for


def test_seed_depends_on_name_and_keys_only() -> None:
    assert seed_for("scene/finetune", 1, 2) == seed_for("scene/finetune", 1, 2)
    assert len({seed_for("a", 1), seed_for("b", 1), seed_for("a", 2), seed_for("a", 1, 0)}) == 4
    assert generator("explore", 0).random() == generator("explore", 0).random()


def test_seed_zero_is_a_seed() -> None:
    assert generator("explore", 0).random() != generator("explore", 1).random()


def test_training_never_sees_an_evaluation_scene() -> None:
    evaluation = {scene_seed(split, run) for split in SPLITS for run in range(20)}
    training = {seed_for("scene/finetune", seed, episode) for seed in range(10) for episode in range(200)}
    collection = _seeds_of_a_collection(0, 1000) | _seeds_of_a_collection(seed_for("held out", 0), 1000)
    assert len(collection) == 2000
    develop = {scene_seed(split, run, "develop") for split in SPLITS for run in range(20)}
    assert len(evaluation) == 40
    assert evaluation.isdisjoint(training | collection | develop)


class _Noting(Robot):
    """Notes the seeds of the scenes that it is reset to."""

    workspace = Workspace("bin", 0.02, 0.02, 0.01)
    primitive = "grasp"

    def __init__(self) -> None:
        self.seeds: set[int] = set()

    def reset(self, scene_seed: int, split: str, count: int | None = None) -> None:
        self.seeds.add(scene_seed)

    def background(self) -> Heightmap:
        return Heightmap(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), np.ones((2, 2), bool))

    def observe(self) -> Observation:
        return Observation(self.background(), self.background().color, self.background().height)

    def execute(self, pick: Pick) -> Outcome:
        return Outcome(False, False, "missed", 0.0, 1.0, 1)

    def bin_empty(self) -> bool:
        return False

    def close(self) -> None: ...


def _seeds_of_a_collection(seed: int, scenes: int) -> set[int]:
    robot = _Noting()
    _scenes(lambda: robot, seed, [(scene, 1) for scene in range(scenes)], 10)
    return robot.seeds
