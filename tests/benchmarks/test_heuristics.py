from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.heuristics import antipodal, colorful

PIXEL, HALF = 0.0025, 0.043


def _bar(turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Color and height of a bar of 90 x 30 mm whose long side is turned from the columns' direction, counter-clockwise."""
    height = np.zeros((144, 144), np.float32)
    corners = cv2.boxPoints(((90.0, 60.0), (90 / 2.5, 30 / 2.5), -turn))  # OpenCV turns clockwise
    cv2.fillPoly(height, [np.round(corners).astype(np.int32)], 0.03)
    color = np.where(height[..., None] > 0, (200, 40, 40), 80).astype(np.uint8)
    return color, height


@pytest.mark.parametrize(("turn", "best"), [(0, 8), (45, 12), (90, 0), (135, 4)])
def test_jaws_close_across_a_bar_and_in_its_middle(turn: float, best: int) -> None:
    _, height = _bar(turn)
    scores = antipodal(height, 16, PIXEL, HALF)
    assert scores.shape == (16, 144, 144)
    angle, row, col = np.unravel_index(scores.argmax(), scores.shape)
    assert abs((angle - best + 8) % 16 - 8) <= 1
    across = np.radians(turn + 90)
    off = abs((col - 90) * np.cos(across) - (row - 60) * np.sin(across))
    along = abs((col - 90) * np.sin(across) + (row - 60) * np.cos(across))
    assert off * PIXEL < 0.004
    assert along * PIXEL < 0.01
    assert height[row, col] > 0
    assert scores[(best + 8) % 16].max() < 0, "along the bar the jaws are too narrow"


def test_suction_goes_for_what_is_least_like_the_floor() -> None:
    color, height = _bar(30)
    score = colorful(color, height, PIXEL)
    assert score.shape == (1, 144, 144)
    _, row, col = np.unravel_index(score.argmax(), score.shape)
    assert np.hypot(row - 60, col - 90) * PIXEL < 0.04
    assert height[row, col] > 0
    assert score[0, 10, 10] == 0
