from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from see2act.robot.scene import AT_REST
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.simulation import file_of


@pytest.fixture(scope="module")
def robot(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("primitive=grasp")


@pytest.mark.parametrize("split", ["seen", "unseen"])
def test_two_copies_of_five_objects_lie_still_in_the_bin(robot: SimulatedRobot, split: str) -> None:
    robot.reset(3, split)
    names = [body.name for body in robot.scene.bodies]
    assert len(names) == 10
    assert sorted(names) == sorted([*set(names)] * 2)
    assert len(set(names)) == 5
    assert set(names) <= set(robot.scene._objects.names(split))
    for body in robot.scene.bodies:
        velocity, _ = robot.simulation.client.getBaseVelocity(body.id)
        assert np.linalg.norm(velocity) < AT_REST
        position = robot.scene.positions()[body.id]
        assert np.abs(position[:2]).max() < 0.18
        assert 0 < position[2] < 0.15
    scales = [body.scale for body in robot.scene.bodies]
    assert min(scales) >= 0.8
    assert max(scales) <= 1.2
    assert len(set(scales)) == 10


def test_truth_masks_lie_where_the_objects_are(robot: SimulatedRobot) -> None:
    robot.reset(4, "seen")
    truth = robot.truth()
    for body, position in robot.scene.positions().items():
        rows, cols = np.nonzero(truth.body == body)
        if len(rows) > 50:
            x, y = robot.workspace.to_world(rows.mean(), cols.mean())
            assert np.hypot(x - position[0], y - position[1]) < 0.03


def test_a_smaller_count_drops_fewer(robot: SimulatedRobot) -> None:
    robot.reset(3, "seen", 2)
    assert len(robot.scene.bodies) == 2


@pytest.fixture
def pile(robot: SimulatedRobot) -> list[int]:
    """Two cubes, one on the other, asleep; their body ids, the lower one first."""
    robot._build()
    for z in (0.025, 0.075):
        robot.scene._add("cube", 1.0, (0.0, 0.0, z), np.array([0.0, 0.0, 0.0, 1.0]), (1.0, 0.2, 0.2))
    assert robot.scene.settle(480)
    return [body.id for body in robot.scene.bodies]


def test_what_sleeps_stays_where_it_is(robot: SimulatedRobot, pile: list[int]) -> None:
    for _ in range(5):  # it takes a step or two to fall asleep
        robot.simulation.step()
    before = robot.scene.positions()
    for _ in range(100):
        robot.simulation.step()
    assert all(np.array_equal(position, before[body]) for body, position in robot.scene.positions().items())


def test_what_loses_its_support_wakes_up_and_falls(robot: SimulatedRobot, pile: list[int]) -> None:
    lower, upper = pile
    height = robot.scene.positions()[upper][2]
    robot.scene.remove({lower})
    assert robot.scene.settle(480)
    assert height - robot.scene.positions()[upper][2] > 0.03


def test_what_is_hit_wakes_up(robot: SimulatedRobot, pile: list[int]) -> None:
    before = robot.scene.positions()
    robot.scene._add("cube", 1.0, (0.12, 0.0, 0.09), np.array([0.0, 0.0, 0.0, 1.0]), (1.0, 0.2, 0.2))
    robot.simulation.client.resetBaseVelocity(robot.scene.bodies[-1].id, (-2.0, 0.0, 0.0))
    for _ in range(240):
        robot.simulation.step()
    moved = [np.linalg.norm(robot.scene.positions()[body] - before[body]) for body in pile]
    assert max(moved) > 0.01


def test_a_scene_follows_from_its_seed_alone(robot: SimulatedRobot) -> None:
    robot.reset(7, "seen")
    before = robot.observe()
    robot.reset(8, "unseen")
    robot.execute(robot.workspace.pick(robot.observe().heightmap, 72, 72, 0.0))
    robot.reset(7, "seen")
    after = robot.observe()
    assert np.array_equal(before.heightmap.height, after.heightmap.height)
    assert np.array_equal(before.color, after.color)


def test_an_object_that_leaves_the_bin_is_counted(robot: SimulatedRobot) -> None:
    robot.reset(3, "seen", 2)
    gone = robot.scene.bodies[0].id
    robot.simulation.client.resetBasePositionAndOrientation(gone, (0.5, 0.3, 0.05), (0, 0, 0, 1))
    outcome = robot.execute(robot.workspace.pick(robot.observe().heightmap, 10, 10, 0.0))
    assert outcome.lost == 1
    assert len(robot.scene.bodies) == 1


def test_robots_of_one_process_share_the_files_that_bullet_keeps_in_memory(make_robot: Callable[..., SimulatedRobot]) -> None:
    """Otherwise each robot would leave its meshes in memory, and each scene the arm's URDF."""
    loaded = []
    for _ in range(2):
        robot = make_robot("primitive=suction")
        for seed in (3, 3):
            robot.reset(seed, "seen")
            client = robot.simulation.client
            shapes = [client.getVisualShapeData(body)[0] for body in sorted(robot.scene.positions())]
            loaded.append([shape[4] for shape in shapes])
    assert all(name.endswith(b".obj") for name in loaded[0])
    assert loaded[0] == loaded[1] == loaded[2] == loaded[3]


def test_a_file_for_bullet_has_the_path_of_its_content() -> None:
    path = file_of(b"first", ".obj")
    assert path == file_of(b"first", ".obj")
    assert path != file_of(b"second", ".obj")
    assert path.read_bytes() == b"first"
