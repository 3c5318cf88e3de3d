from __future__ import annotations

import multiprocessing
from collections.abc import Callable

import numpy as np
import pytest
from see2act.robot.robot import SimulatedRobot
from see2act.robot.scene import AT_REST


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
    robot.reset(5, "seen")
    truth = robot.truth()
    for body, position in robot.scene.positions().items():
        rows, cols = np.nonzero(truth.body == body)
        if len(rows) > 50:
            x, y = robot.workspace.to_world(rows.mean(), cols.mean())
            assert np.hypot(x - position[0], y - position[1]) < 0.03


def test_a_smaller_count_drops_fewer(robot: SimulatedRobot) -> None:
    robot.reset(3, "seen", 2)
    assert robot.objects_left == 2


def _episode(queue: multiprocessing.Queue) -> None:
    from hydra import compose, initialize_config_module
    from see2act import build
    from see2act.config import register

    register()
    with initialize_config_module("see2act.conf", version_base="1.3"):
        cfg = compose("train", ["paths.output=.", "primitive=grasp"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    trace = []
    for scene in (11, 12):
        robot.reset(scene, "seen")
        rng = np.random.default_rng(scene)
        for _ in range(3):
            truth, heightmap = robot.truth(), robot.observe().heightmap
            row, col = rng.permutation(np.argwhere(truth.body >= 0))[0]
            outcome = robot.execute(robot.workspace.pick(heightmap, int(row), int(col), float(rng.integers(16) * np.pi / 16)))
            trace.append((heightmap.height.tobytes(), heightmap.color.tobytes(), outcome))
    robot.close()
    queue.put(trace)


@pytest.mark.slow
def test_same_seed_and_picks_give_the_same_outcomes_in_two_busy_processes() -> None:
    context = multiprocessing.get_context("spawn")
    queues = [context.Queue() for _ in range(2)]
    jobs = [context.Process(target=_episode, args=(queue,)) for queue in queues]
    for job in jobs:
        job.start()
    first, second = (queue.get(timeout=300) for queue in queues)
    for job in jobs:
        job.join(60)
    assert len(first) == 6
    assert first == second


def test_a_scene_follows_from_its_seed_alone(robot: SimulatedRobot) -> None:
    robot.reset(7, "seen")
    before = robot.observe()
    robot.reset(8, "unseen")
    robot.execute(robot.workspace.pick(robot.observe().heightmap, 72, 72, 0.0))
    robot.reset(7, "seen")
    after = robot.observe()
    assert np.array_equal(before.heightmap.height, after.heightmap.height)
    assert np.array_equal(before.color, after.color)
