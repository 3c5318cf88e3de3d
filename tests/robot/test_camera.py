from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from see2act.robot import heightmap as hm
from see2act.robot.camera import DepthNoise
from see2act.robot.oracle import ExactHeights
from see2act.robot.simulated import SimulatedRobot


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
    robot.scene._block((0.03, 0.015, 0.02), (0.08, 0.04, 0.02), (1, 0, 0))
    color, depth, _ = robot.camera.render(robot.simulation)
    heightmap = robot._heightmap(color, depth)
    red = (heightmap.color[..., 0] > 100) & (heightmap.color[..., 1] < 50)
    rows, cols = np.nonzero(red & (heightmap.height > 0.035))
    x, y = robot.workspace.to_world(rows.mean(), cols.mean())
    assert (x, y) == pytest.approx((0.08, 0.04), abs=0.002)
    assert np.ptp(cols) * 0.0025 == pytest.approx(0.06, abs=0.006)
    assert np.ptp(rows) * 0.0025 == pytest.approx(0.03, abs=0.006)
    assert np.median(heightmap.height[rows, cols]) == pytest.approx(0.04, abs=5e-4)


def test_intrinsics_and_pose_agree_with_the_renderer(robot: SimulatedRobot) -> None:
    _, depth, body = robot.camera.render(robot.simulation)
    points = hm.point_cloud(depth, robot.camera.intrinsics, robot.camera.pose)
    inside = np.abs(points[..., :2]).max(-1) < 0.18  # and not the outer side of the floor's slab
    floor = points[(body == robot.scene.floor) & inside]
    assert len(floor) > 10000
    assert np.abs(floor[:, 2]).max() < 1e-5


def test_noise_grows_with_distance_squared() -> None:
    noise = DepthNoise(blur=0, step=1e-6)
    spread = [
        (noise(np.full((200, 200), z, np.float32), np.zeros((200, 200)), np.random.default_rng(0)) - z).std() / z**2
        for z in (0.5, 0.75, 1.0)
    ]
    assert spread == pytest.approx([0.08 / (930 * 0.055)] * 3, rel=0.05)


def test_readings_are_lost_at_depth_edges_only() -> None:
    depth = np.full((100, 100), 0.7, np.float32)
    depth[:, 50:] = 0.6
    sensed = DepthNoise()(depth, np.zeros_like(depth), np.random.default_rng(0))
    lost = np.argwhere(sensed == 0)
    assert 40 < len(lost) < 160
    assert set(lost[:, 1]) <= {49, 50}


def test_readings_are_lost_at_grazing_angles(robot: SimulatedRobot) -> None:
    """Of a plane that runs away from the camera, where it is seen at more than 80 degrees."""
    camera = replace(robot.camera, crop=None, width=320, height=160, focal=230.0, noise=DepthNoise(edge_rate=0.0))
    v = np.indices((160, 320))[0] + 0.5 - camera.intrinsics[1, 2]
    slope = np.tan(np.radians(79))  # of the plane's normal against the optical axis
    depth = (1.0 / (1 + slope * v / 230.0)).clip(0.2, 3.0)
    angle = np.degrees(np.abs(np.radians(79) - np.arctan(v / 230.0)))
    assert np.allclose(np.degrees(camera.incidence(depth))[80:140, 160], angle[80:140, 160], atol=0.5)
    lost = camera.sense(depth, np.zeros(depth.shape, bool), np.random.default_rng(0)) == 0
    assert angle[85:].max() < 79
    assert not lost[85:].any()
    assert angle[57:67].min() > 81
    assert lost[57:67].mean() == pytest.approx(0.8, abs=0.03)


def test_disparity_is_quantised() -> None:
    noise = DepthNoise(sigma=0.0)
    depth = np.linspace(0.5, 0.9, 5000, dtype=np.float32).reshape(50, 100)
    steps = 930 * 0.055 / noise(depth, np.zeros_like(depth), np.random.default_rng(0)) * 32
    assert np.allclose(steps, np.round(steps), atol=1e-2)


@pytest.mark.parametrize(
    ("camera", "primitive"), [("side", "suction"), ("side", "grasp"), ("top", "suction"), ("top", "grasp")]
)
def test_the_arm_at_home_neither_hides_the_bin_nor_enters_the_heightmap(
    make_robot: Callable[..., SimulatedRobot], camera: str, primitive: str
) -> None:
    robot = make_robot(f"camera={camera}", f"primitive={primitive}")
    robot.reset(4, "seen")
    _, depth, body = robot.camera.render(robot.simulation)
    points = hm.point_cloud(depth, robot.camera.intrinsics, robot.camera.pose)
    eye = robot.camera.pose[:3, 3]
    behind = eye + (points - eye) * (eye[2] / (eye[2] - points[..., 2]))[..., None]  # where the ray would meet the floor
    assert not ((body == robot.arm.body) & (np.abs(behind[..., :2]).max(-1) < 0.18)).any()
    heightmap, exact = robot.observe().heightmap, ExactHeights(robot).height
    assert heightmap.valid.mean() > 0.7
    assert np.median(np.abs(heightmap.height - exact)) < 0.002
    assert (np.abs(heightmap.height - exact) > 0.02)[5:-5, 5:-5].mean() < 0.08


def test_the_camera_above_sees_more_of_the_bin(make_robot: Callable[..., SimulatedRobot]) -> None:
    seen = {}
    for camera in ("side", "top"):
        robot = make_robot(f"camera={camera}")
        robot.reset(4, "seen")
        seen[camera] = robot.truth().heightmap.valid.mean()
    assert seen["top"] > seen["side"] + 0.05


def test_neither_the_arm_nor_the_table_is_in_the_cameras_sight_but_in_a_bystanders(
    make_robot: Callable[..., SimulatedRobot],
) -> None:
    filmed, robot = make_robot("camera=top", "robot.video=true"), make_robot("camera=top")
    for each in (filmed, robot):
        each.reset(3, "seen")
    seen, shown = filmed.observe(), filmed.camera.render(filmed.simulation)
    *_, body = filmed._look()
    hidden = (filmed.arm.body, filmed.scene.table)
    assert not np.isin(body, hidden).any()
    assert (shown[2] == filmed.arm.body).any()
    elsewhere = ~np.isin(shown[2], hidden)
    assert np.array_equal(seen.color[elsewhere], shown[0][elsewhere])
    assert np.array_equal(seen.depth, robot.observe().depth), "filming changes what the robot sees"


@pytest.mark.parametrize("overrides", [(), ("camera=top",), ("camera=d415", "workspace=suction_real", "objects=household")])
def test_the_part_of_the_image_that_is_rendered_has_the_pixels_of_the_whole(
    make_robot: Callable[..., SimulatedRobot], overrides: tuple[str, ...]
) -> None:
    robot = make_robot(*overrides)
    robot.reset(5, "seen")
    top, left, rows, cols = robot.camera.crop
    part = np.s_[top : top + rows, left : left + cols]
    whole = replace(robot.camera, crop=None)
    assert rows * cols < 0.6 * whole.width * whole.height
    with robot.simulation.hidden(robot.arm.body):
        color, depth, body = robot.camera.render(robot.simulation)
        all_color, all_depth, all_body = whole.render(robot.simulation)
    assert np.abs(depth - all_depth[part]).max() < 1e-5
    # Where two faces meet, rounding decides which of them a pixel shows.
    assert (color != all_color[part]).any(-1).mean() < 2e-4
    assert (body != all_body[part]).mean() < 2e-4
    points = hm.point_cloud(all_depth, whole.intrinsics, whole.pose)
    assert np.allclose(points[part], hm.point_cloud(depth, robot.camera.intrinsics, robot.camera.pose), atol=1e-5)
    *_, used = hm.highest(points, all_depth > 0, robot.workspace)
    rendered = np.zeros(all_depth.shape, bool)
    rendered[part] = True
    assert rendered.ravel()[used].all(), "a pixel that the heightmap is made of is not rendered"
