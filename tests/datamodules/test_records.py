"""A robot whose bin a person fills: nothing that happened is lost, made again, or learned from if it was aborted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from see2act.attempt import Attempt
from see2act.datamodules.interactive import InteractiveDataModule
from see2act.datamodules.records import Records, training
from see2act.datamodules.replay import Replay
from see2act.policy import Choice, Policy
from see2act.robot.group import RobotGroup
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick
from see2act.seeding import generator
from tests.datamodules.cells import SIDE, WORKSPACE


class Attended(Robot):
    """A bin of eight by eight cells, all of them full. It writes down what it is told to do."""

    workspace = WORKSPACE
    primitive = "suction"
    attended = True

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.as_it_was = True
        self.causes: list = []
        """Of the next attempts; ``ok`` afterwards."""

    def reset(self, scene_seed: int, split: str, count: int | None = None) -> None:
        self.calls.append("reset")

    def resume(self, scene_seed: int, attempts: int) -> bool:
        self.calls.append(f"resume after {attempts}")
        return self.as_it_was

    def background(self) -> Heightmap:
        raise NotImplementedError

    def observe(self) -> Observation:
        height = np.full((SIDE, SIDE), 0.03, np.float32)
        heightmap = Heightmap(np.zeros((SIDE, SIDE, 3), np.uint8), height, np.ones((SIDE, SIDE), bool))
        return Observation(heightmap, heightmap.color, height)

    def execute(self, pick: Pick) -> Outcome:
        self.calls.append(f"pick {pick.row} {pick.col}")
        cause = self.causes.pop(0) if self.causes else "ok"
        return Outcome(cause == "ok", None, cause, 1.0, 2.0, 0)

    def bin_empty(self) -> bool:
        return False

    def close(self) -> None:
        pass


@pytest.fixture
def robot() -> Attended:
    return Attended()


@pytest.fixture
def make(robot: Attended, tmp_path: Path) -> Callable[[], InteractiveDataModule]:
    def made() -> InteractiveDataModule:
        replay = Replay(
            alpha=0.6,
            beta=0.4,
            floor=0.01,
            mirror=False,
            rotation=0,
            shift=0,
            color_jitter=0,
            pixel=0.0025,
            rng=generator("r", 0),
        )
        policy = Policy("suppress", True, 0.0025, radius=0.002, changed_radius=0.0025)
        settings = {"seed": 0, "batch_size": 4, "updates": 2, "temperature": 0.0, "episode_attempts": 4}
        return InteractiveDataModule(
            RobotGroup(lambda: robot, 1), WORKSPACE, policy, replay, records=Records(tmp_path), **settings
        )

    return made


def _heights(color: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Prefers cells in their order."""
    return -np.arange(SIDE * SIDE, dtype=np.float32).reshape(1, SIDE, SIDE)


def _attempt(data: InteractiveDataModule) -> Attempt:
    data.start_episodes()
    observations = data.observe()
    decisions = data.decide(observations, _heights)
    (made,) = data.remember(observations, decisions, data.act(decisions), [0.1, 0.2, 0.3])
    return made.attempt


def test_a_record_is_what_happened(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    heightmap = Heightmap(rng.integers(0, 255, (4, 5, 3), np.uint8), rng.random((4, 5), np.float32), rng.random((4, 5)) > 0.5)
    observation = Observation(heightmap, rng.integers(0, 255, (9, 8, 3), np.uint8), rng.random((9, 8), np.float32))
    outcome = Outcome(False, None, "slipped", 3.5, 12.0, 0)
    attempt = Attempt(observation, Choice(3, 1, 2, 0.5, True, 1.5), Pick(1, 2, 0.6, 0.1, 0.2, 0.03), outcome, 0.1, 0.2, 12.0)
    Records(tmp_path / "attempts").save(training(7), attempt)
    again = Records(tmp_path / "attempts").load(training(7))
    assert again is not None
    assert (again.choice, again.pick, again.outcome, again.t_act) == (attempt.choice, attempt.pick, outcome, 12.0)
    for name in ("color", "height", "valid"):
        assert np.array_equal(getattr(again.heightmap, name), getattr(heightmap, name))
    assert np.array_equal(again.observation.depth, observation.depth)
    assert Records(tmp_path / "attempts").load(training(8)) is None


def test_an_attempt_is_kept_before_anything_is_learned_from_it(
    make: Callable[[], InteractiveDataModule], tmp_path: Path
) -> None:
    data = make()
    _attempt(data)
    assert [path.name for path in tmp_path.glob("*.npz")] == ["finetune-00001.npz"]


def test_an_aborted_attempt_teaches_nothing_and_is_not_repeated(
    make: Callable[[], InteractiveDataModule], robot: Attended, tmp_path: Path
) -> None:
    data = make()
    robot.causes = ["protective_stop"]
    assert _attempt(data).outcome.aborted
    assert (data.attempts, len(data.replay)) == (0, 0)
    assert (tmp_path / "aborted-00001-1.npz").exists()
    assert not (tmp_path / "finetune-00001.npz").exists()
    _attempt(data)
    assert (data.attempts, len(data.replay)) == (1, 1)
    picks = [call for call in robot.calls if call.startswith("pick")]
    assert len(set(picks)) == 2, "the pick that made the robot stop must not be tried again"


def test_an_attempt_that_was_made_and_not_learned_from_is_taken_from_its_record(
    make: Callable[[], InteractiveDataModule], robot: Attended
) -> None:
    data = make()
    _attempt(data)
    state = data.state_dict()
    robot.causes = ["no_seal"]
    lost = _attempt(data)  # and then the run is killed
    robot.calls.clear()
    again = make()
    again.load_state_dict(state)
    made = _attempt(again)
    assert robot.calls == [], "nothing may move for an attempt that happened already"
    assert (made.pick, made.outcome) == (lost.pick, lost.outcome)
    assert (again.attempts, len(again.replay)) == (2, 2)


@pytest.mark.parametrize("as_it_was", [True, False])
def test_a_run_goes_on_in_its_scene_if_a_person_says_so(
    make: Callable[[], InteractiveDataModule], robot: Attended, as_it_was: bool
) -> None:
    data = make()
    robot.causes = ["no_seal"]
    _attempt(data)
    _attempt(data)
    state, episode = data.state_dict(), data._bins[0].episode
    robot.calls.clear()
    robot.as_it_was = as_it_was
    again = make()
    again.load_state_dict(state)
    assert robot.calls == [], "picks of a real robot are not made again"
    _attempt(again)
    assert robot.calls[0] == "resume after 2"
    assert ("reset" in robot.calls) != as_it_was
    assert again._bins[0].episode == episode + (not as_it_was)


def test_what_failed_in_the_scene_is_still_left_alone(make: Callable[[], InteractiveDataModule], robot: Attended) -> None:
    data = make()
    robot.causes = ["no_seal"]
    failed = _attempt(data)
    again = make()
    again.load_state_dict(data.state_dict())
    assert _attempt(again).pick != failed.pick


def test_every_attempt_is_worth_a_checkpoint(make: Callable[[], InteractiveDataModule]) -> None:
    data = make()
    _attempt(data)
    assert not data._bins[0].over
    assert data.is_worth_a_checkpoint
