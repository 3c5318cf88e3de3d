from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from see2act.robot import heightmap as hm
from see2act.robot.camera import DepthNoise
from see2act.robot.robot import SimulatedRobot


@pytest.fixture(scope="module")
def robot(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    robot = make_robot()
    robot._build()
    return robot


def test_the_floor_of_the_empty_bin_is_at_zero(robot: SimulatedRobot) -> None:
    background = robot.background()
    assert np.abs(background.height[20:-20, 20:-20]).max() < 1e-5


def test_the_walls_are_not_in_the_heightmap(robot: SimulatedRobot) -> None:
    robot._build()
    robot._noise = np.random.default_rng(0)
    assert (robot.observe().heightmap.height > 0.01).mean() < 0.002


def test_a_box_appears_where_it_stands(robot: SimulatedRobot) -> None:
    robot._build()
    robot._scene._block((0.03, 0.015, 0.02), (0.08, 0.04, 0.02), (1, 0, 0))
    color, depth, _ = robot._camera.render(robot._simulation)
    heightmap = robot._heightmap(color, depth)
    red = (heightmap.color[..., 0] > 100) & (heightmap.color[..., 1] < 50)
    rows, cols = np.nonzero(red & (heightmap.height > 0.035))
    x, y = robot.workspace.to_world(rows.mean(), cols.mean())
    assert (x, y) == pytest.approx((0.08, 0.04), abs=0.002)
    assert np.ptp(cols) * 0.0025 == pytest.approx(0.06, abs=0.006)
    assert np.ptp(rows) * 0.0025 == pytest.approx(0.03, abs=0.006)
    assert np.median(heightmap.height[rows, cols]) == pytest.approx(0.04, abs=5e-4)


def test_intrinsics_and_pose_agree_with_the_renderer(robot: SimulatedRobot) -> None:
    _, depth, body = robot._camera.render(robot._simulation)
    points = hm.point_cloud(depth, robot._camera.intrinsics, robot._camera.pose)
    inside = np.abs(points[..., :2]).max(-1) < 0.18  # and not the outer side of the floor's slab
    floor = points[(body == robot._scene.floor) & inside]
    assert len(floor) > 10000
    assert np.abs(floor[:, 2]).max() < 1e-5


def test_noise_grows_with_distance_squared() -> None:
    noise = DepthNoise(blur=0, step=1e-6)
    spread = [(noise(np.full((200, 200), z, np.float32), np.random.default_rng(0)) - z).std() / z**2 for z in (0.5, 0.75, 1.0)]
    assert spread == pytest.approx([0.08 / (930 * 0.055)] * 3, rel=0.05)


def test_readings_are_lost_at_depth_edges_only() -> None:
    depth = np.full((100, 100), 0.7, np.float32)
    depth[:, 50:] = 0.6
    sensed = DepthNoise()(depth, np.random.default_rng(0))
    lost = np.argwhere(sensed == 0)
    assert 40 < len(lost) < 160
    assert set(lost[:, 1]) <= {49, 50}
