from __future__ import annotations

import numpy as np
import pytest

from see2act.modules.average_precision import average_precision


def test_average_precision_is_the_mean_precision_at_each_label() -> None:
    scores = np.array([[[0.9, 0.8, 0.7, 0.6, 0.1]]], np.float32)
    labels = np.array([[[True, False, True, False, True]]])
    assert average_precision(scores, labels) == pytest.approx((1 / 1 + 2 / 3 + 3 / 5) / 3)
    assert average_precision(labels.astype(np.float32), labels) == 1
    rng = np.random.default_rng(0)
    many = rng.random((4, 50, 50)) < 0.1
    assert average_precision(rng.random(many.shape, np.float32), many) == pytest.approx(0.1, abs=0.02)


def test_average_precision_forgives_small_shifts() -> None:
    labels = np.zeros((1, 40, 40), bool)
    labels[0, 10:30, 20] = True
    shifted = np.roll(labels, 2, axis=2).astype(np.float32)
    assert average_precision(shifted, labels, tolerance=2) == 1
    assert average_precision(shifted, labels, tolerance=1) < 0.1
    assert average_precision(np.ones_like(shifted), labels, tolerance=2) == pytest.approx(0.064, abs=0.01)


def test_average_precision_without_labels_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one label"):
        average_precision(np.zeros((1, 4, 4), np.float32), np.zeros((1, 4, 4), bool))
