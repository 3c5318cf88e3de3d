"""The simulated twin of the paper's real set-up: its workspaces, camera, gripper and objects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hydra.utils import instantiate

from see2act.robot import heightmap as hm
from see2act.robot.household import HOUSEHOLD
from see2act.robot.objects import ObjectSet, shape
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.textures import TEXTURES
from see2act.robot.types import RobotError

REAL = ("camera=d415", "objects=household")


@pytest.fixture(scope="module")
def robot(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("workspace=suction_real", *REAL)


@pytest.mark.parametrize(("workspace", "shape"), [("suction_real", (208, 288)), ("grasp_rg2_real", (400, 400))])
def test_workspaces_are_the_paper_s(config: Callable, workspace: str, shape: tuple[int, int]) -> None:
    assert instantiate(config(f"workspace={workspace}").workspace).shape == shape


@pytest.mark.parametrize(("workspace", "primitive"), [("suction_real", "suction"), ("grasp_rg2_real", "grasp_rg2")])
def test_the_arm_reaches_all_of_them(make_robot: Callable[..., SimulatedRobot], workspace: str, primitive: str) -> None:
    robot = make_robot(f"workspace={workspace}", f"primitive={primitive}")
    rows, cols = robot.workspace.shape
    low = float(robot.tool.depth_at(np.array(0.0)))
    for row in (0, rows // 2, rows - 1):
        for col in (0, cols // 2, cols - 1):
            for z in (low, 0.27):
                for angle in np.arange(0, np.pi, np.pi / 4):
                    at = np.array([*robot.workspace.to_world(row, col), z + robot.tool.length()])
                    assert robot.arm.solve(at, angle) is not None, (row, col, z, angle)


def test_25_seen_and_10_unseen_of_which_two_are_transparent(config: Callable) -> None:
    objects = instantiate(config("objects=household").objects, _convert_="all")
    assert (len(objects.seen), len(objects.unseen)) == (25, 10)
    assert {*objects.seen, *objects.unseen} == set(HOUSEHOLD)
    assert len(set(objects.transparent) & set(objects.unseen)) == 2
    assert not set(objects.transparent) & set(objects.seen)


@pytest.mark.parametrize("name", HOUSEHOLD)
def test_household_shapes_are_convex_parts(name: str) -> None:
    assert all(part.is_volume and part.is_convex for part in shape(name).parts)


def test_the_depth_sensor_looks_through_glass(robot: SimulatedRobot) -> None:
    robot._build()
    robot._noise = np.random.default_rng(0)
    for name, x in (("tumbler", -0.08), ("candle", 0.08)):
        robot.scene._add(name, 1.0, (x, 0.0, 0.04), np.array([0.0, 0.0, 0.0, 1.0]), (0.8, 0.8, 0.9))
    robot.scene.settle(480)
    glass, wax = (body.id for body in robot.scene.bodies)
    _, depth, body = robot.camera.render(robot.simulation)
    observation = robot.observe()
    missing = observation.depth == 0
    assert missing[body == glass].mean() == pytest.approx(0.5, abs=0.15)
    assert missing[body == wax].mean() < 0.2
    points = hm.point_cloud(observation.depth, robot.camera.intrinsics, robot.camera.pose)
    read = (body == glass) & ~missing
    assert np.abs(np.median(points[read][:, 2])) < 0.005  # the floor behind, not the 6 cm of the tumbler
    row, col = (int(i) for i in robot.workspace.to_pixel(np.array(-0.08), np.array(0.0)))
    assert observation.heightmap.height[row, col] < 0.01
    assert robot.truth().heightmap.height[row, col] > 0.05
    solid = (body == wax) & ~missing
    assert np.median(np.abs(observation.depth[solid] - depth[solid])) < 0.002


def test_a_ray_meets_the_floor_where_the_camera_says(robot: SimulatedRobot) -> None:
    points = hm.point_cloud(robot.camera.floor_depth(), robot.camera.intrinsics, robot.camera.pose)
    assert np.abs(points[400:, :, 2]).max() < 1e-6  # single precision


def test_the_wide_gripper_opens_as_far_as_an_rg2_and_picks(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot("workspace=grasp_rg2_real", "primitive=grasp_rg2", *REAL)
    assert robot.tool.opening(0.0) == pytest.approx(0.110, abs=0.002)
    assert robot.half_opening == pytest.approx(0.055, abs=0.001)
    robot._build()
    robot._noise = np.random.default_rng(0)
    robot.scene._add("apple", 1.1, (0.15, 0.1, 0.05), np.array([0.0, 0.0, 0.0, 1.0]), (1.0, 0.2, 0.2))
    robot.scene.settle(480)
    x, y, _ = robot.scene.positions()[robot.scene.bodies[0].id]
    row, col = (int(i) for i in robot.workspace.to_pixel(np.array(x), np.array(y)))
    outcome = robot.execute(robot.workspace.pick(robot.truth().heightmap, row, col, 0.5))
    assert (outcome.success, outcome.truth) == (True, True)


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_patterns(name: str) -> None:
    image = TEXTURES[name]()
    assert image.shape == (64, 64, 3)
    assert 0.05 < (image < 128).mean() < 0.7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transparent": ("ghost",)}, r"objects\.transparent names \['ghost'\]"),
        ({"textures": {"cube": "plaid"}}, r"no texture is called \['plaid'\]; choose from stripes"),
    ],
)
def test_unknown_looks_are_refused(changes: dict, message: str) -> None:
    good = {"seen": ("cube", "brick", "can", "ell", "tee"), "unseen": ("arch", "zed", "slant", "channel", "decagon")}
    with pytest.raises(RobotError, match=message):
        ObjectSet("mine", **{**good, **changes})
