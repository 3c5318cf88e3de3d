from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from omegaconf import DictConfig

from see2act.errors import ConfigError
from see2act.experiment.checks import check_parts, validate
from see2act.robot.floors import MATERIALS, floor_picture
from see2act.robot.objects import shape
from see2act.robot.simulated import SimulatedRobot
from see2act.seeding import generator

TEXTURED = ("robot.bin.floor=textured", "robot.bin.distractors=6", "robot.layouts=null")


@pytest.mark.parametrize("material", MATERIALS)
def test_a_material_has_texture_and_follows_from_its_generator(material: Callable) -> None:
    pictures = [material(generator("test", seed), 200, 300).clip(0, 1) for seed in (0, 0, 1)]
    assert pictures[0].shape == (200, 300, 3)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.abs(pictures[0] - pictures[2]).mean() > 0.01
    assert pictures[0].std(axis=(0, 1)).max() > 0.02


def test_what_is_printed_is_as_large_as_the_object() -> None:
    bare, printed = (floor_picture(generator("test", 3), 0.4, 0.3, shapes) for shapes in ([], [shape("puck")]))
    area = (bare != printed).any(axis=-1).sum() / 1000**2
    # Between its side and its face, less what lies beyond the floor.
    assert 0 < area <= 1.1 * np.hypot(0.06 * 0.03, np.pi * 0.03**2)


def test_a_textured_floor_changes_what_is_seen_and_nothing_else(make_robot: Callable[..., SimulatedRobot]) -> None:
    plain, textured = make_robot("robot.layouts=null"), make_robot(*TEXTURED)
    for robot in (plain, textured):
        robot.reset(5, "seen")
    views = [robot.truth() for robot in (plain, textured)]
    np.testing.assert_array_equal(views[0].body, views[1].body)
    objects = views[0].body >= 0
    flat = ~objects & views[0].heightmap.valid & views[1].heightmap.valid & (views[0].heightmap.height < 0.001)
    assert np.abs(views[0].heightmap.height - views[1].heightmap.height).max() < 0.0005
    np.testing.assert_array_equal(views[0].heightmap.color[objects], views[1].heightmap.color[objects])
    assert views[0].heightmap.color[flat].std() < 10
    assert views[1].heightmap.color[flat].std() > 20
    pick = plain.workspace.pick(views[0].heightmap, *np.argwhere(objects)[objects.sum() // 2], 0.0)
    assert plain.execute(pick) == textured.execute(pick)


def test_a_scene_has_its_own_floor_and_keeps_it(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot(*TEXTURED)
    colors = []
    for seed in (1, 2, 1):
        robot.reset(seed, "seen")
        colors.append(robot.truth().heightmap.color)
    np.testing.assert_array_equal(colors[0], colors[2])
    assert (colors[0] != colors[1]).mean() > 0.5


@pytest.mark.parametrize(
    "wrong", [["robot.bin.floor=grass"], ["robot.bin.distractors=3"], [*TEXTURED, "robot.bin.distractors=-1"]]
)
def test_a_floor_that_cannot_be_made_is_refused(config: Callable[..., DictConfig], wrong: list[str]) -> None:
    cfg = config(*wrong)
    with pytest.raises(ConfigError, match=r"robot\.bin\."):
        check_parts(cfg)


def test_labels_by_vision_want_a_floor_that_they_can_subtract(config: Callable[..., DictConfig]) -> None:
    with pytest.raises(ConfigError, match="use labels=truth"):
        validate(config("task=foreground", "labels=vision", *TEXTURED))
