from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from see2act.modules.rotation import Rotations, sampling_grid, warp_nearest

GRASP = Rotations((144, 144), 16, 4)


def _bar(angle: float) -> torch.Tensor:
    """Input whose height channel holds a thin bar at ``angle``, counter-clockwise seen from above."""
    x = torch.zeros(1, 4, 144, 144)
    for t in torch.linspace(-45, 45, 400):
        # Rows grow towards -y.
        x[0, 3, round(float(71.5 - t * math.sin(angle))), round(float(71.5 + t * math.cos(angle)))] = 1
    return x


@pytest.mark.parametrize("k", range(16))
def test_the_turn_makes_its_own_angle_horizontal(k: int) -> None:
    turned = GRASP.all(_bar(k * math.pi / 16))[:, 3]
    rows = [(image.sum(1) > 0).sum().item() for image in turned]
    assert min(rows) == rows[k]
    assert rows[k] <= 3
    assert all(rows[j] > 10 for j in range(16) if j != k)


def test_no_part_of_the_bin_is_cut_off() -> None:
    assert min(GRASP.canvas) >= math.hypot(144, 144)
    for corner in ((0, 0), (0, 143), (143, 0), (143, 143)):
        x = torch.zeros(1, 4, 144, 144)
        x[0, 3, max(0, corner[0] - 2) : corner[0] + 3, max(0, corner[1] - 2) : corner[1] + 3] = 1
        assert (GRASP.all(x)[:, 3].flatten(1).sum(1) >= 5).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 15), st.integers(2, 141), st.integers(2, 141))
def test_rotate_and_back(k: int, row: int, col: int) -> None:
    x = torch.zeros(1, 4, 144, 144)
    x[0, 3, row - 1 : row + 2, col - 1 : col + 2] = 1
    turned = GRASP.all(x)
    back = GRASP.back(turned[:, 3:])
    assert back[k, row, col] == 1
    i, j = GRASP.locate(torch.tensor([k]), torch.tensor([row]), torch.tensor([col]))
    assert turned[k, 3, i, j] == 1


@pytest.mark.parametrize("shape", [(144, 144), (145, 142), (143, 145)])
@pytest.mark.parametrize("count", [1, 16])
def test_the_first_angle_changes_nothing(shape: tuple[int, int], count: int) -> None:
    rotations = Rotations(shape, count, 4)
    x = torch.randn(1, 4, *shape)
    turned = rotations.all(x)[:1]
    back = torch.cat([rotations.back(turned[:, i : i + 1].expand(count, -1, -1, -1))[:1] for i in range(4)])
    assert torch.allclose(back, x[0], atol=1e-3)  # bilinear weights are 1 but for rounding


@pytest.mark.parametrize("shape", [(144, 144), (145, 143)])
def test_a_window_of_odd_heightmaps_is_the_canvas_there(shape: tuple[int, int]) -> None:
    rotations = Rotations(shape, 16, 4)
    x = torch.randn(16, 4, *shape)
    angle, row, col = torch.arange(16), torch.arange(16) * 4 + 40, torch.arange(16) * 3 + 50
    window, rows, cols = rotations.window(x, angle, row, col, 8)
    whole = rotations.turned(x, angle)
    i, j = rotations.locate(angle, row, col)
    # Colour; of two heights equally near either may be taken.
    assert torch.allclose(window[range(16), :3, rows, cols], whole[range(16), :3, i, j], atol=1e-3)


def test_resampling_agrees_with_an_exact_quarter_turn() -> None:
    x = torch.randn(1, 1, 32, 32)
    grid = sampling_grid(torch.tensor([math.pi / 2]), (32, 32), (32, 32))
    # What points along +y (up) must become horizontal (to the right): a clockwise quarter turn of the image.
    assert torch.equal(warp_nearest(x, grid), torch.rot90(x, -1, (2, 3)))


def test_windows_stay_on_the_canvas_and_hold_their_pixel() -> None:
    x = torch.randn(4, 4, 144, 144)
    angle, row, col = torch.tensor([0, 5, 8, 15]), torch.tensor([0, 143, 70, 3]), torch.tensor([143, 0, 70, 99])
    windows, i, j = GRASP.window(x, angle, row, col, 48)
    turned = GRASP.turned(x, angle)
    rows, cols = GRASP.locate(angle, row, col)
    n = torch.arange(4)
    assert windows.shape[2:] == (100, 100)
    assert torch.equal(windows[n, :, i, j], turned[n, :, rows, cols])
    assert ((rows - i) % 4 == 0).all()
    assert ((cols - j) % 4 == 0).all()


@pytest.mark.parametrize("turn", [-0.7, 0.098, 3.1])
def test_a_window_turns_about_its_pixel(turn: float) -> None:
    """What is at the pixel stays there; a bar that leans by the turn becomes horizontal."""
    angle, row, col = torch.tensor([5]), torch.tensor([60]), torch.tensor([80])
    x = torch.zeros(1, 4, 144, 144)
    lean = float(GRASP.angles[5]) + turn
    for t in torch.linspace(-30, 30, 300):
        x[0, 3, round(float(60 - t * math.sin(lean))), round(float(80 + t * math.cos(lean)))] = 1
    window, i, j = GRASP.window(x, angle, row, col, 48, torch.tensor([turn]))
    assert window[0, 3, i - 1 : i + 2, j].max() == 1
    assert (window[0, 3].sum(1) > 0).sum() <= 4
    plain, *_ = GRASP.window(x, angle, row, col, 48)
    assert (plain[0, 3].sum(1) > 0).sum() > 4 or abs(turn) > 3


def test_a_window_is_shifted_along_the_canvas() -> None:
    suction = Rotations((144, 144), 1, 4)
    x = torch.randn(1, 4, 144, 144)
    pixel = torch.tensor([0]), torch.tensor([60]), torch.tensor([80])
    window, i, j = suction.window(x, *pixel, 48, None, torch.tensor([[2.0, -3.0]]))
    assert torch.allclose(window[0, :, i.item(), j.item()], x[0, :, 62, 77], atol=1e-3)
    assert torch.allclose(window[0, :, i.item() + 5, j.item() + 7], x[0, :, 67, 84], atol=1e-3)
