"""Trial and error as a data module."""

from __future__ import annotations

from typing import Any

import pytest
from see2act.datamodules.interactive import InteractiveDataModule
from see2act.datamodules.replay import Replay
from see2act.policy import Policy
from see2act.seeding import generator, seed_for


class Recorder:
    """A robot that is asked for a scene and goes no further."""

    def __init__(self) -> None:
        self.scenes: list[int] = []

    def reset(self, seed: int, split: str) -> None:
        self.scenes.append(seed)
        raise StopIteration


def _first_scene(seed: int, **scenes: Any) -> int:
    robot = Recorder()
    replay = Replay(0.6, 0.4, 0.01, False, 0.0, 0.0, 0.0, 0.0025, rng=generator("replay", seed))
    data = InteractiveDataModule(robot, Policy("argmax", False, 0.0025), replay, seed, 8, 4, 0.0, 15, **scenes)  # type: ignore[arg-type]
    with pytest.raises(StopIteration):
        data.act(lambda color, height: height[None])
    return robot.scenes[0]


def test_training_scenes_to_choose_settings_by_are_not_the_benchmark_s() -> None:
    benchmark = {_first_scene(seed) for seed in range(5)}
    assert benchmark == {seed_for("scene/finetune", seed, 0) for seed in range(5)}
    assert not benchmark & {_first_scene(seed, scenes="develop") for seed in range(5)}
