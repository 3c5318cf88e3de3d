from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import logit

from see2act.errors import DivergedError
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.policy import Policy, room_between_walls
from see2act.robot.types import Heightmap


def _heightmap(height: np.ndarray) -> Heightmap:
    return Heightmap(np.zeros((*height.shape, 3), np.uint8), height.astype(np.float32), np.ones(height.shape, bool))


@pytest.fixture
def flat() -> Heightmap:
    return _heightmap(np.zeros((40, 40)))


@pytest.fixture
def logits() -> np.ndarray:
    maps = np.zeros((16, 40, 40))
    maps[3, 20, 20], maps[9, 5, 5] = 5.0, 4.0
    return maps


def test_takes_the_best_pixel_and_angle(flat: Heightmap, logits: np.ndarray) -> None:
    choice = Policy("suppress", True, 0.0025).choose(logits, flat)
    assert (choice.angle, choice.row, choice.col) == (3, 20, 20)
    assert choice.score == pytest.approx(1 / (1 + np.exp(-5)))


def test_argmax_repeats_a_failure_and_suppress_does_not(flat: Heightmap, logits: np.ndarray) -> None:
    for policy, expected in ((Policy("argmax", False, 0.0025), 3), (Policy("suppress", True, 0.0025), 9)):
        choice = policy.choose(logits, flat)
        policy.remember(choice, flat, success=False)
        assert policy.choose(logits, flat).angle == expected


def test_suppressed_neighbourhood_has_the_configured_size(flat: Heightmap) -> None:
    policy = Policy("suppress", True, 0.0025, radius=0.01, angles=2)
    maps = np.full((16, 40, 40), -9.0)
    maps[3, 20, 20] = 5.0
    policy.remember(policy.choose(maps, flat), flat, success=False)
    for angle, row, expected in ((3, 24, False), (3, 25, True), (5, 20, False), (6, 20, True)):
        other = maps.copy()
        other[angle, row, 20] = 9.0
        choice = policy.choose(other, flat)
        assert ((choice.angle, choice.row) == (angle, row)) is expected


def test_what_is_left_alone_does_not_depend_on_the_resolution() -> None:
    logits = np.full((1, 80, 80), -9.0)
    logits[0, 40, 40] = 5.0
    fine = _heightmap(np.zeros((80, 80)))
    policy = build.policy(composed(["workspace.pixel=0.00125"]))
    policy.remember(policy.choose(logits, fine), fine, success=False)
    for row, expected in ((56, False), (57, True)):  # 20 mm, and more
        other = logits.copy()
        other[0, row, 40] = 9.0
        assert (policy.choose(other, fine).row == row) is expected
    changed = np.zeros((80, 80), np.float32)
    changed[60:, :] = 0.03  # the last 13 mm of 30
    assert policy.choose(logits, _heightmap(changed)).row == 40


def test_a_changed_scene_is_tried_again(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True, 0.0025)
    policy.remember(policy.choose(logits, flat), flat, success=False)
    changed = np.zeros((40, 40))
    changed[12:24, 12:24] = 0.03
    assert policy.choose(logits, _heightmap(changed)).angle == 3


def test_sensor_noise_is_no_change(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True, 0.0025)
    policy.remember(policy.choose(logits, flat), flat, success=False)
    noise = np.random.default_rng(0).normal(0, 0.001, (40, 40))
    assert policy.choose(logits, _heightmap(noise)).angle == 9


def test_a_success_elsewhere_leaves_the_memory(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True, 0.0025)
    first = policy.choose(logits, flat)
    policy.remember(first, flat, success=False)
    policy.remember(second := policy.choose(logits, flat), flat, success=True)
    assert policy.choose(logits, flat) == second != first


def test_a_success_can_clear_the_memory(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True, 0.0025, until_success=True)
    first = policy.choose(logits, flat)
    policy.remember(first, flat, success=False)
    policy.remember(policy.choose(logits, flat), flat, success=True)
    assert policy.choose(logits, flat) == first


def test_temperature_draws_in_proportion_to_the_softmax(flat: Heightmap) -> None:
    maps = np.full((1, 40, 40), -50.0)
    maps[0, 1, 1], maps[0, 30, 30] = logit(0.9), logit(0.88)
    rng = np.random.default_rng(0)
    draws = [Policy("suppress", True, 0.0025).choose(maps, flat, 0.02, rng) for _ in range(2000)]
    share = np.mean([not choice.explored for choice in draws])
    assert share == pytest.approx(np.e / (1 + np.e), abs=0.03)


def test_a_model_that_expects_only_failure_looks_everywhere(flat: Heightmap) -> None:
    maps = np.full((1, 40, 40), -12.0)
    maps[0, :, 20] = -6.0
    rng = np.random.default_rng(0)
    draws = [Policy("suppress", True, 0.0025).choose(maps, flat, 0.02, rng).col for _ in range(400)]
    assert np.mean(np.array(draws) == 20) < 0.1


@pytest.mark.parametrize(
    ("footprint", "expected"),
    [
        ((0, 0), (0, 20, 0)),
        ((0.01, 0.01), (20, 11, 0)),
        ((0.03, 0.01), (20, 11, 8)),  # jaws along x have no room at column 11, jaws along y do
    ],
)
def test_the_tool_has_room_between_the_walls(
    flat: Heightmap, footprint: tuple[float, float], expected: tuple[int, int, int]
) -> None:
    maps = np.zeros((16, 40, 40))
    maps[0, 0, 20], maps[0, 20, 11], maps[8, 20, 11] = 3.0, 2.0, 1.0
    choice = Policy("suppress", True, 0.0025, footprint=footprint).choose(maps, flat)
    assert (choice.row, choice.col, choice.angle) == expected


@pytest.mark.slow
def test_a_gripper_in_the_outermost_pixels_it_may_use_touches_no_wall(make_robot: Callable) -> None:
    """The number in conf/ is that of the gripper itself: in an empty bin no pick ends at a wall."""
    robot, cfg = make_robot("primitive=grasp"), composed(["primitive=grasp"])
    robot.reset(0, "seen", count=0)
    heightmap = robot.observe().heightmap
    room = room_between_walls((16, *heightmap.height.shape), build.policy(cfg).footprint, cfg.workspace.pixel)
    for angle in range(0, 16, 3):
        rows, cols = np.nonzero(room[angle])
        for row, col in ((rows.min(), cols.min()), (rows.max(), cols.max()), (rows.min(), cols.max())):
            pick = robot.workspace.pick(heightmap, int(row), int(col), angle * np.pi / 16)
            assert robot.execute(pick).cause != "wall", (angle, row, col)


def test_something_is_chosen_even_when_all_has_failed() -> None:
    flat = _heightmap(np.zeros((5, 5)))
    policy = Policy("suppress", True, 0.0025, radius=1.0, footprint=(0.0025, 0.0025))
    maps = np.arange(25.0).reshape(1, 5, 5)
    for _ in range(2):
        choice = policy.choose(maps, flat)
        assert (choice.row, choice.col) == (3, 3)  # the best that the walls leave room for
        policy.remember(choice, flat, success=False)


def test_a_network_that_has_diverged_does_not_pick(flat: Heightmap) -> None:
    maps = np.zeros((1, 40, 40))
    maps[0, 3, 4] = np.nan
    for temperature in (0.0, 0.02):
        with pytest.raises(DivergedError, match=r"the network has diverged: lower finetune\.backbone_lr"):
            Policy("argmax", False, 0.0025).choose(maps, flat, temperature, np.random.default_rng(0))


def test_entropy_tells_how_sure_a_draw_is(flat: Heightmap) -> None:
    policy, rng = Policy("argmax", False, 0.0025), np.random.default_rng(0)
    everywhere = policy.choose(np.zeros((16, 40, 40)), flat, 0.02, rng)
    assert everywhere.entropy == pytest.approx(np.log(16 * 40 * 40))
    two = np.full((16, 40, 40), -40.0)
    two[0, 3, 4] = two[1, 5, 6] = 40.0
    assert policy.choose(two, flat, 0.02, rng).entropy == pytest.approx(np.log(2))
    assert policy.choose(two, flat).entropy == 0
