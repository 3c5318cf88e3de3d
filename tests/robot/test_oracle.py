from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from see2act.attempt import attempt
from see2act.policy import Policy
from see2act.robot.end_effector import EndEffector
from see2act.robot.oracle import HOPELESS, oracle
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import RobotError

PLAIN = Policy("argmax", False, 0.0025)
ANGLES = {"suction": 1, "grasp": 16}


@pytest.fixture(scope="module", params=["suction", "grasp"])
def robot(request: pytest.FixtureRequest, make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot(f"primitive={request.param}")


@pytest.mark.slow
def test_the_oracle_clears_most_of_a_bin(robot: SimulatedRobot) -> None:
    robot.reset(21, "unseen")
    scores = oracle(robot, ANGLES[robot.primitive])
    outcomes = [attempt(robot, scores, PLAIN).outcome for _ in range(10)]
    assert sum(outcome.success for outcome in outcomes) >= 8


def test_the_oracle_moves_nothing(robot: SimulatedRobot) -> None:
    """It plans; a pick tried in the simulator would not be planning."""
    robot.reset(22, "seen", 4)
    heightmap, steps, before = robot.observe().heightmap, robot.simulation.steps, robot.scene.positions()
    logits = oracle(robot, ANGLES[robot.primitive])(heightmap.color, heightmap.height)
    assert logits.shape == (ANGLES[robot.primitive], 144, 144)
    assert robot.simulation.steps == steps
    assert all(np.array_equal(before[body], at) for body, at in robot.scene.positions().items())


def test_only_objects_are_worth_a_pick(robot: SimulatedRobot) -> None:
    robot.reset(23, "seen", 3)
    heightmap, body = robot.observe().heightmap, robot.truth().body
    best = oracle(robot, ANGLES[robot.primitive])(heightmap.color, heightmap.height).max(0)
    row, col = np.unravel_index(best.argmax(), best.shape)
    assert body[row, col] >= 0
    far_from_objects = np.ones_like(best, bool)
    for r, c in np.argwhere(body >= 0):
        far_from_objects[max(0, r - 6) : r + 7, max(0, c - 6) : c + 7] = False
    assert (best[far_from_objects] == HOPELESS).all()


def test_there_is_no_oracle_for_a_tool_it_does_not_know(robot: SimulatedRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        robot, "tool", object.__new__(type("Magnet", (EndEffector,), dict.fromkeys(EndEffector.__abstractmethods__)))
    )
    with pytest.raises(RobotError, match="no oracle for Magnet"):
        oracle(robot, 1)
