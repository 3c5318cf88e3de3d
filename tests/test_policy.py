from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logit
from see2act.policy import Policy
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
    choice = Policy("suppress", True).choose(logits, flat)
    assert (choice.angle, choice.row, choice.col) == (3, 20, 20)
    assert choice.score == pytest.approx(1 / (1 + np.exp(-5)))


def test_argmax_repeats_a_failure_and_suppress_does_not(flat: Heightmap, logits: np.ndarray) -> None:
    for policy, expected in ((Policy("argmax", False), 3), (Policy("suppress", True), 9)):
        choice = policy.choose(logits, flat)
        policy.remember(choice, flat, success=False)
        assert policy.choose(logits, flat).angle == expected


def test_suppressed_neighbourhood_has_the_configured_size(flat: Heightmap) -> None:
    policy = Policy("suppress", True, radius=4, angles=2)
    maps = np.full((16, 40, 40), -9.0)
    maps[3, 20, 20] = 5.0
    policy.remember(policy.choose(maps, flat), flat, success=False)
    for angle, row, expected in ((3, 24, False), (3, 25, True), (5, 20, False), (6, 20, True)):
        other = maps.copy()
        other[angle, row, 20] = 9.0
        choice = policy.choose(other, flat)
        assert ((choice.angle, choice.row) == (angle, row)) is expected


def test_a_changed_scene_is_tried_again(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True)
    policy.remember(policy.choose(logits, flat), flat, success=False)
    changed = np.zeros((40, 40))
    changed[12:24, 12:24] = 0.03
    assert policy.choose(logits, _heightmap(changed)).angle == 3


def test_sensor_noise_is_no_change(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True)
    policy.remember(policy.choose(logits, flat), flat, success=False)
    noise = np.random.default_rng(0).normal(0, 0.001, (40, 40))
    assert policy.choose(logits, _heightmap(noise)).angle == 9


def test_success_clears_the_memory(flat: Heightmap, logits: np.ndarray) -> None:
    policy = Policy("suppress", True)
    first = policy.choose(logits, flat)
    policy.remember(first, flat, success=False)
    policy.remember(policy.choose(logits, flat), flat, success=True)
    assert policy.choose(logits, flat) == first


def test_temperature_draws_in_proportion_to_the_softmax(flat: Heightmap) -> None:
    maps = np.full((1, 40, 40), -50.0)
    maps[0, 1, 1], maps[0, 30, 30] = logit(0.9), logit(0.88)
    rng = np.random.default_rng(0)
    draws = [Policy("suppress", True).choose(maps, flat, 0.02, rng) for _ in range(2000)]
    share = np.mean([not choice.explored for choice in draws])
    assert share == pytest.approx(np.e / (1 + np.e), abs=0.03)


def test_a_model_that_expects_only_failure_looks_everywhere(flat: Heightmap) -> None:
    maps = np.full((1, 40, 40), -12.0)
    maps[0, :, 20] = -6.0
    rng = np.random.default_rng(0)
    draws = [Policy("suppress", True).choose(maps, flat, 0.02, rng).col for _ in range(400)]
    assert np.mean(np.array(draws) == 20) < 0.1


@pytest.mark.parametrize(("margin", "expected"), [(0, (0, 20)), (4, (30, 30)), (5, (30, 30))])
def test_the_margin_along_the_walls_is_never_chosen(flat: Heightmap, margin: int, expected: tuple[int, int]) -> None:
    maps = np.zeros((16, 40, 40))
    maps[0, 0, 20], maps[1, 36, 36], maps[2, 30, 30] = 5.0, 4.0, 3.0
    choice = Policy("suppress", True, margin=margin).choose(maps, flat)
    assert (choice.row, choice.col) == expected


def test_something_is_chosen_even_when_all_has_failed() -> None:
    flat = _heightmap(np.zeros((5, 5)))
    policy = Policy("suppress", True, radius=20)
    maps = np.zeros((1, 5, 5))
    policy.remember(policy.choose(maps, flat), flat, success=False)
    assert policy.choose(maps, flat).logit == 0.0


def test_entropy_tells_how_sure_a_draw_is(flat: Heightmap) -> None:
    policy, rng = Policy("argmax", False), np.random.default_rng(0)
    everywhere = policy.choose(np.zeros((16, 40, 40)), flat, 0.02, rng)
    assert everywhere.entropy == pytest.approx(np.log(16 * 40 * 40))
    two = np.full((16, 40, 40), -40.0)
    two[0, 3, 4] = two[1, 5, 6] = 40.0
    assert policy.choose(two, flat, 0.02, rng).entropy == pytest.approx(np.log(2))
    assert policy.choose(two, flat).entropy == 0
