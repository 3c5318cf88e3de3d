from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hydra.utils import instantiate
from ur_analytic_ik import ur5

from see2act.robot import urdf
from see2act.robot.arm import Arm, pointing_down
from see2act.robot.simulation import Simulation

LIMIT = 2.8
"""Rad; the joints' limits are at pi, and a solution near them would mean a wrist that must turn back half-way."""


@pytest.fixture(scope="module")
def arm(config: Callable) -> Iterator[Arm]:
    simulation = Simulation()
    simulation.clear()
    arm = Arm(simulation, instantiate(config().robot.arm, _convert_="all"), urdf.mount(urdf.ur5(), urdf.robotiq()), jumps=False)
    arm.load()
    yield arm
    simulation.close()


def test_solver_reaches_the_whole_workspace_at_all_angles(arm: Arm) -> None:
    for x in np.linspace(-0.18, 0.18, 9):
        for y in np.linspace(-0.18, 0.18, 9):
            for z in (0.13, 0.25, 0.35):
                for k in range(16):
                    joints = arm.solve(np.array([x, y, z]), k * np.pi / 16)
                    assert joints is not None, (x, y, z, k)
                    assert np.abs(joints).max() < LIMIT


def test_solution_is_the_pose_in_the_simulated_arm(arm: Arm) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        position = np.array([*rng.uniform(-0.18, 0.18, 2), rng.uniform(0.13, 0.35)])
        angle = rng.integers(16) * np.pi / 16
        arm.teleport(arm.solve(position, angle))
        assert np.linalg.norm(arm.tool_position() - position) < 5e-4
        # A tool is the same after half a turn, so its x axis may point either way along the angle.
        wanted = pointing_down(angle)
        turned = arm.tool_rotation()
        cosine = (np.trace(turned.T @ wanted @ np.diag([np.sign(turned[:, 0] @ wanted[:, 0])] * 2 + [1])) - 1) / 2
        assert np.degrees(np.arccos(min(1, cosine))) < 0.2


def test_out_of_reach_is_none(arm: Arm) -> None:
    assert arm.solve(np.array([1.0, 0.0, 0.2]), 0.0) is None
    assert arm.line(np.array([0.1, 0, 0.3]), np.array([1.0, 0, 0.3]), 0.0, 0.5) is None


def test_motion_follows_the_straight_line(arm: Arm) -> None:
    start, end = np.array([0.1, 0.1, 0.3]), np.array([0.1, 0.1, 0.14])
    arm.teleport(arm.solve(start, 1.0))
    off = []

    def watch() -> bool:
        off.append(np.linalg.norm((arm.tool_position() - start)[:2]))
        return False

    arm.follow(arm.line(start, end, 1.0, 0.4), until=watch)
    arm.wait(20)
    assert max(off) < 1e-3
    assert np.linalg.norm(arm.tool_position() - end) < 5e-4


def test_a_line_is_straight_between_the_points_that_are_solved(arm: Arm) -> None:
    for start, end, angle in (((0.18, -0.18, 0.3), (0.18, -0.18, 0.13), 2.9), ((-0.18, 0.1, 0.2), (-0.18, 0.1, 0.3), 0.4)):
        start, end = np.array(start), np.array(end)
        for joints in arm.line(start, end, angle, 0.4):
            off = np.cross(arm.position(joints) - start, end - start) / np.linalg.norm(end - start)
            assert np.linalg.norm(off) < 1e-6


def test_neighbouring_poses_have_neighbouring_joints(arm: Arm) -> None:
    line = arm.line(np.array([-0.18, -0.18, 0.2]), np.array([0.18, 0.18, 0.2]), 0.5, 0.4)
    assert np.abs(np.diff(line, axis=0)).max() < 0.05


def test_commanded_position_is_forward_kinematics(arm: Arm) -> None:
    position = np.array([0.05, -0.1, 0.2])
    arm.teleport(arm.solve(position, 0.3))
    assert np.allclose(arm.commanded_position, position, atol=1e-6)
    assert len(ur5.forward_kinematics(0, 0, 0, 0, 0, 0)) == 4
