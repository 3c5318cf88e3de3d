from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from see2act.datamodules.replay import BLOCK, Replay, _Priorities
from see2act.errors import DivergedError


def _filled(n: int, alpha: float = 0.6, beta: float = 0.4) -> Replay:
    replay = Replay(alpha, beta, 0.01, True, 0.1, 0.0025, 0.3, 0.0025, np.random.default_rng(0))
    for i in range(n):
        color = np.full((4, 4, 3), i, np.uint8)
        replay.add(color, np.full((4, 4), i / 100, np.float32), i % 16, i % 4, 3 - i % 4, i % 2 == 0)
    return replay


def test_a_batch_holds_what_was_added() -> None:
    batch = _filled(10).sample(8)
    for i in range(8):
        k = int(batch["color"][i, 0, 0, 0])
        assert batch["height"][i, 0, 0].item() == pytest.approx(k / 100)
        assert (batch["angle"][i], batch["row"][i], batch["col"][i]) == (k, k % 4, 3 - k % 4)
        assert batch["label"][i] == float(k % 2 == 0)
    assert batch["color"].dtype == torch.uint8
    assert batch["label"].dtype == torch.float32


def test_heightmaps_are_kept_to_a_tenth_of_a_millimetre() -> None:
    rng = np.random.default_rng(0)
    color, height = rng.integers(0, 256, (9, 7, 3), np.uint8), rng.uniform(-0.01, 0.3, (9, 7)).astype(np.float32)
    replay = Replay(0.6, 0.4, 0.01, True, 0.1, 0.0025, 0.3, 0.0025, rng)
    replay.add(color, height, 0, 0, 0, True)
    batch = replay.sample(1)
    assert (batch["color"][0].numpy() == color).all()
    assert batch["height"].dtype == torch.float32
    assert np.abs(batch["height"][0].numpy() - height).max() < 0.51e-4


def test_success_is_that_of_the_last_attempts() -> None:
    replay = _filled(10)
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 0, 0, True)
    assert (replay.success(1), replay.success(4), replay.success(99)) == (1, 0.5, 6 / 11)


def test_the_newest_attempt_is_in_every_batch() -> None:
    replay = _filled(50)
    assert all(replay.sample(4)["color"][0, 0, 0, 0] == 49 for _ in range(10))


def test_sampling_follows_priorities() -> None:
    replay = _filled(3, alpha=1.0)
    replay._drawn = np.array([0, 1, 2])
    replay.update(np.array([0.79, 0.09, 0.09]))
    drawn = np.concatenate([replay.sample(100)["color"][1:, 0, 0, 0].numpy() for _ in range(30)])
    assert np.bincount(drawn, minlength=3) / len(drawn) == pytest.approx([0.8, 0.1, 0.1], abs=0.03)


def test_draws_across_blocks_follow_priorities() -> None:
    n = 2 * BLOCK + 500
    priorities = _Priorities(0.5)
    for i in range(n):
        priorities.append(float(i % 7) + 0.01)
    drawn = priorities.draw(200_000, np.random.default_rng(1))
    expected = np.sqrt(np.arange(n) % 7 + 0.01)
    assert priorities.probability(np.arange(n)) == pytest.approx(expected / expected.sum())
    for start in (0, BLOCK, 2 * BLOCK):
        part = slice(start, start + BLOCK)
        share = np.bincount(drawn, minlength=n)[part].sum() / len(drawn)
        assert share == pytest.approx(expected[part].sum() / expected.sum(), abs=0.01)
    assert np.bincount(drawn % 7, minlength=7)[0] < 0.02 * len(drawn)


def test_priorities_that_are_no_numbers_end_the_run() -> None:
    replay = _filled(5)
    replay.sample(3)
    replay.update(np.array([0.1, np.nan, 0.2]))
    with pytest.raises(DivergedError, match=r"the network has diverged: lower finetune\.backbone_lr"):
        replay.sample(3)


def test_importance_weights_undo_the_bias() -> None:
    replay = _filled(2, alpha=1.0, beta=1.0)
    replay._drawn = np.array([0, 1])
    replay.update(np.array([0.79, 0.19]))
    batch = replay.sample(64)
    weight = {int(k): float(w) for k, w in zip(batch["color"][:, 0, 0, 0], batch["weight"], strict=True)}
    assert weight == pytest.approx({0: 0.25, 1: 1.0})


def test_a_new_attempt_gets_the_largest_priority() -> None:
    replay = _filled(3)
    replay._drawn = np.array([1])
    replay.update(np.array([5.0]))
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 0, 0, True)
    assert replay._priorities.values()[-1] == pytest.approx(5.01)


def test_save_and_load_continue_the_same_draws() -> None:
    replay = _filled(20)
    replay.sample(8)
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored = Replay(0.6, 0.4, 0.01, True, 0.1, 0.0025, 0.3, 0.0025, np.random.default_rng(99))
    restored.load_state_dict(torch.load(file, weights_only=True))
    for _ in range(3):
        a, b = replay.sample(8), restored.sample(8)
        assert all(torch.equal(a[k], b[k]) for k in a)
        replay.update(np.linspace(0, 1, 8))
        restored.update(np.linspace(0, 1, 8))


def test_the_last_draw_is_described() -> None:
    replay = _filled(3)
    batch = replay.sample(64)
    drawn = batch["color"][:, 0, 0, 0].numpy().astype(int)
    replay.update(np.where(drawn == 0, 0.49, 0.19))
    described = replay.last_draw()
    assert described["age"] == pytest.approx(2 - drawn.mean())
    assert described["priority"] == pytest.approx(np.where(drawn == 0, 0.5, 0.2).mean())
    assert described["successes"] == pytest.approx((drawn % 2 == 0).mean())


def test_variations_stay_within_their_bounds() -> None:
    batch = _filled(3).sample(200)
    for name, bound in (("turn", 0.1), ("shift", 1.0)):
        assert 0.9 * bound < batch[name].abs().max() <= bound
        assert batch[name].mean().abs() < 0.1 * bound
    mixture = batch["tint"][:, :, :3]
    assert ((mixture > 0).sum(1) == 1).all()  # each channel is used once
    assert ((mixture > 0).sum(2) == 1).all()
    strength = mixture.sum(2)
    assert 0.7 <= strength.min() < 0.72
    assert 1.28 < strength.max() <= 1.3
    assert 0.14 < batch["tint"][:, :, 3].abs().max() <= 0.15


def test_shifts_are_in_metres() -> None:
    replay = Replay(0.6, 0.4, 0.01, True, 0.1, 0.0025, 0.3, 0.00125, np.random.default_rng(0))
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 1, 1, True)
    assert 1.9 < replay.sample(200)["shift"].abs().max() <= 2  # pixels


def test_nothing_varies_unless_asked() -> None:
    replay = Replay(0.6, 0.4, 0.01, False, 0.0, 0.0, 0.0, 0.0025, np.random.default_rng(0))
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 0, 0, True)
    batch = replay.sample(50)
    assert not batch["mirror"].any()
    assert not batch["turn"].any()
    assert not batch["shift"].any()
    assert torch.equal(batch["tint"], torch.eye(3, 4).expand(50, 3, 4))
