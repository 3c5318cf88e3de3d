"""Prioritized experience replay."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from see2act.datamodules.replay import Replay
from see2act.errors import DivergedError
from see2act.modules.affordance import AttemptBatch


def _replay(seed: int = 0, **more: Any) -> Replay:
    settings = {"alpha": 0.6, "beta": 0.4, "floor": 0.01, "mirror": True, "rotation": 0.1, "shift": 0.0025}
    settings |= {"color_jitter": 0.3, "pixel": 0.0025, "rng": np.random.default_rng(seed)}
    return Replay(**(settings | more))


def _filled(n: int, **more: Any) -> Replay:
    """Attempts that can be told by their colour."""
    replay = _replay(**more)
    for i in range(n):
        color = np.full((4, 4, 3), i, np.uint8)
        replay.add(color, np.full((4, 4), i / 100, np.float32), i % 16, i % 4, 3 - i % 4, i % 2 == 0)
    return replay


def _drawn(batch: AttemptBatch) -> np.ndarray:
    return batch.color[:, 0, 0, 0].numpy().astype(int)


def test_a_batch_holds_what_was_added() -> None:
    batch = _filled(10).sample(8)
    for i, k in enumerate(_drawn(batch)):
        assert batch.replay_index[i] == k
        assert batch.height[i, 0, 0].item() == pytest.approx(k / 100)
        assert (batch.angle[i], batch.row[i], batch.col[i]) == (k, k % 4, 3 - k % 4)
        assert batch.label[i] == float(k % 2 == 0)
    assert batch.color.dtype == torch.uint8
    assert batch.label.dtype == torch.float32


def test_heightmaps_are_kept_to_a_tenth_of_a_millimetre() -> None:
    rng = np.random.default_rng(0)
    color, height = rng.integers(0, 256, (9, 7, 3), np.uint8), rng.uniform(-0.01, 0.3, (9, 7)).astype(np.float32)
    replay = _replay()
    replay.add(color, height, 0, 0, 0, True)
    batch = replay.sample(1)
    assert (batch.color[0].numpy() == color).all()
    assert batch.height.dtype == torch.float32
    assert np.abs(batch.height[0].numpy() - height).max() < 0.51e-4


def test_success_is_that_of_the_last_attempts() -> None:
    replay = _filled(10)
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 0, 0, True)
    assert (replay.success(1), replay.success(4), replay.success(99)) == (1, 0.5, 6 / 11)


def test_the_newest_attempt_is_in_every_batch() -> None:
    replay = _filled(50)
    assert all(replay.sample(4).replay_index[0] == 49 for _ in range(10))


def test_sampling_follows_priorities() -> None:
    replay = _filled(3, alpha=1.0)
    replay.update(np.arange(3), np.array([0.79, 0.09, 0.09]))
    drawn = np.concatenate([_drawn(replay.sample(100))[1:] for _ in range(30)])
    assert np.bincount(drawn, minlength=3) / len(drawn) == pytest.approx([0.8, 0.1, 0.1], abs=0.03)


def test_draws_among_thousands_follow_the_power_of_their_priorities() -> None:
    n = 2500
    replay = _replay(alpha=0.5)
    scene = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32)
    for _ in range(n):
        replay.add(*scene, 0, 0, 0, True)
    replay.update(np.arange(n), np.arange(n) % 7)
    index = np.concatenate([replay.sample(1000).replay_index[1:].numpy() for _ in range(100)])
    expected = np.sqrt(np.arange(7) + 0.01)
    assert np.bincount(index % 7) / len(index) == pytest.approx(expected / expected.sum(), abs=0.01)
    thirds = np.bincount(index * 3 // n, minlength=3) / len(index)
    assert thirds == pytest.approx([1 / 3] * 3, abs=0.01)


def test_priorities_that_are_no_numbers_end_the_run() -> None:
    replay = _filled(5)
    replay.update(replay.sample(3).replay_index.numpy(), np.array([0.1, np.nan, 0.2]))
    with pytest.raises(DivergedError, match=r"the network has diverged: lower finetune\.backbone_lr"):
        replay.sample(3)


def test_importance_weights_undo_the_bias() -> None:
    replay = _filled(2, alpha=1.0, beta=1.0)
    replay.update(np.arange(2), np.array([0.79, 0.19]))
    batch = replay.sample(64)
    weight = dict(zip(_drawn(batch).tolist(), batch.weight.tolist(), strict=True))
    assert weight == pytest.approx({0: 0.25, 1: 1.0})


def test_a_new_attempt_gets_the_largest_priority() -> None:
    replay = _filled(3)
    replay.update(np.arange(3), np.array([0.5, 5.0, 0.5]))
    replay.add(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), 0, 0, 0, True)
    assert replay.statistics(np.array([3]))["priority"] == pytest.approx(5.01)


def test_save_and_load_continue_the_same_draws() -> None:
    replay = _filled(20)
    replay.sample(8)
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored = _replay(seed=99)
    restored.load_state_dict(torch.load(file, weights_only=True))
    for _ in range(3):
        a, b = replay.sample(8), restored.sample(8)
        assert all(torch.equal(x, y) for x, y in zip([*a[:-1], *a.augmentation], [*b[:-1], *b.augmentation], strict=True))
        replay.update(a.replay_index.numpy(), np.linspace(0, 1, 8))
        restored.update(b.replay_index.numpy(), np.linspace(0, 1, 8))


def test_a_batch_is_described() -> None:
    replay = _filled(3)
    batch = replay.sample(64)
    drawn = _drawn(batch)
    replay.update(batch.replay_index.numpy(), np.where(drawn == 0, 0.49, 0.19))
    described = replay.statistics(batch.replay_index.numpy())
    assert described["age"] == pytest.approx(2 - drawn.mean())
    assert described["priority"] == pytest.approx(np.where(drawn == 0, 0.5, 0.2).mean())
    assert described["successes"] == pytest.approx((drawn % 2 == 0).mean())


def test_augmentation_stays_within_its_bounds() -> None:
    augmentation = _filled(3).sample(200).augmentation
    for values, bound in ((augmentation.rotation, 0.1), (augmentation.shift, 1.0)):
        assert 0.9 * bound < values.abs().max() <= bound
        assert values.mean().abs() < 0.1 * bound
    mixture = augmentation.mixtures[:, :, :3]
    assert ((mixture > 0).sum(1) == 1).all()  # each channel is used once
    assert ((mixture > 0).sum(2) == 1).all()
    strength = mixture.sum(2)
    assert 0.7 <= strength.min() < 0.72
    assert 1.28 < strength.max() <= 1.3
    assert 0.14 < augmentation.mixtures[:, :, 3].abs().max() <= 0.15


def test_shifts_are_in_metres() -> None:
    replay = _filled(1, pixel=0.00125)
    assert 1.9 < replay.sample(200).augmentation.shift.abs().max() <= 2  # pixels


def test_nothing_varies_unless_asked() -> None:
    augmentation = _filled(1, mirror=False, rotation=0.0, shift=0.0, color_jitter=0.0).sample(50).augmentation
    assert not augmentation.mirror.any()
    assert not augmentation.rotation.any()
    assert not augmentation.shift.any()
    assert torch.equal(augmentation.mixtures, torch.eye(3, 4).expand(50, 3, 4))
