"""The paper's protocol, on a robot that is only a counter."""

from __future__ import annotations

import numpy as np
import pytest

from see2act.experiment.evaluation import EvaluationProtocol, EvaluationRun, evaluate, scene_seed
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick
from see2act.robot.workspace import Workspace
from tests.factory import attempt_row


class CountingRobot(Robot):
    """Succeeds at every second attempt, but for the first of a scene that truly holds nothing; the bin holds ``objects``."""

    workspace = Workspace("bin", 0.1, 0.1, 0.0125)
    primitive = "suction"

    def __init__(self, objects: int):
        self._objects = objects
        self.resets: list[tuple[int, str]] = []
        self.picks: list[Pick] = []

    def background(self) -> Heightmap:
        raise NotImplementedError  # evaluation has no use for it

    def reset(self, scene_seed: int, split: str, count: int | None = None) -> None:
        self.resets.append((scene_seed, split))
        self._left, self._tries = self._objects, 0

    def observe(self) -> Observation:
        heightmap = Heightmap(np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.float32), np.ones((8, 8), bool))
        return Observation(heightmap, heightmap.color, heightmap.height)

    def execute(self, pick: Pick) -> Outcome:
        self.picks.append(pick)
        self._tries += 1
        success = self._tries % 2 == 0
        self._left -= success
        return Outcome(success, success and self._tries > 2, "ok" if success else "missed", 0.0, 1.0, 1)

    def bin_empty(self) -> bool:
        return self._left == 0

    def close(self) -> None:
        self.resets.clear()


def _affordances(color: np.ndarray, height: np.ndarray) -> np.ndarray:
    return np.arange(16 * 64, dtype=np.float32).reshape(16, 8, 8) / 1000


@pytest.mark.parametrize(("objects", "seen", "unseen"), [(10, 20, 15), (30, 25, 15), (2, 4, 4)])
def test_a_run_ends_when_the_bin_is_empty_or_its_attempts_are_spent(objects: int, seen: int, unseen: int) -> None:
    robot, tests = CountingRobot(objects), list[EvaluationRun]()
    protocol = EvaluationProtocol(runs=2, attempts={"seen": 25, "unseen": 15})
    result = evaluate(robot, _affordances, Policy("suppress", True, 0.0025), protocol, lambda attempt, test: tests.append(test))
    assert [run.attempts for run in result.seen.runs] == [seen, seen]
    assert [run.attempts for run in result.unseen.runs] == [unseen, unseen]
    assert result.seen.successes == 2 * (seen // 2)
    assert result.seen.truth_successes == 2 * (seen // 2 - 1)
    assert result.seen.rate == pytest.approx(seen // 2 / seen)
    assert robot.resets == [(scene_seed(split, run), split) for split in ("seen", "unseen") for run in range(2)]
    assert len(tests) == 2 * (seen + unseen)
    assert {test.scene_seed for test in tests} == {seed for seed, _ in robot.resets}


def test_settings_can_be_chosen_by_other_scenes() -> None:
    robot = CountingRobot(2)
    evaluate(
        robot,
        _affordances,
        Policy("argmax", False, 0.0025),
        EvaluationProtocol(1, {"seen": 1, "unseen": 1}, "develop"),
        lambda attempt, test: None,
    )
    assert robot.resets == [(scene_seed(split, 0, "develop"), split) for split in ("seen", "unseen")]
    assert robot.resets != [(scene_seed(split, 0), split) for split in ("seen", "unseen")]


def test_the_last_angle_and_pixel_become_a_pick_in_the_world() -> None:
    robot = CountingRobot(1)
    evaluate(
        robot,
        _affordances,
        Policy("argmax", False, 0.0025),
        EvaluationProtocol(1, {"seen": 1, "unseen": 1}),
        lambda attempt, test: None,
    )
    pick = robot.picks[0]
    assert (pick.row, pick.col) == (7, 7)
    assert pick.angle == pytest.approx(15 * np.pi / 16)
    assert (pick.x, pick.y) == pytest.approx((0.04375, -0.04375))


def test_every_run_starts_with_an_empty_memory() -> None:
    robot = CountingRobot(10)
    evaluate(
        robot,
        _affordances,
        Policy("suppress", True, 0.0025, radius=0.0025),
        EvaluationProtocol(2, {"seen": 1, "unseen": 1}),
        lambda attempt, test: None,
    )
    assert len({(pick.row, pick.col, pick.angle) for pick in robot.picks}) == 1


def test_test_runs_that_are_known_are_counted_and_not_made_again() -> None:
    protocol = EvaluationProtocol(runs=2, attempts={"seen": 25, "unseen": 15})
    policy = Policy("suppress", True, 0.0025)
    whole = evaluate(CountingRobot(3), _affordances, policy, protocol, lambda attempt, test: None)
    outcomes = [(False, False), (True, False), (False, False), (True, True), (False, False), (True, True)]
    known = {("seen", 1): [attempt_row(success=success, truth=truth) for success, truth in outcomes]}
    robot, tests = CountingRobot(3), list[EvaluationRun]()
    assert evaluate(robot, _affordances, policy, protocol, lambda attempt, test: tests.append(test), known=known) == whole
    assert robot.resets == [(scene_seed("seen", 0), "seen"), *((scene_seed("unseen", run), "unseen") for run in range(2))]
    assert ("seen", 1) not in {(test.split, test.run) for test in tests}
