from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from see2act.modules.rotation import Rotations, sampling_grid, warp_nearest

GRASP = Rotations((144, 144), 16, 4, receptive_radius=48)


def _all(rotations: Rotations, x: torch.Tensor) -> list[torch.Tensor]:
    """Every turn of an input, each on its canvas."""
    return [rotations.turned(x, torch.tensor([k]), canvas)[0] for k, canvas in enumerate(rotations.canvases)]


def _bar(angle: float) -> torch.Tensor:
    """Input whose height channel holds a thin bar at ``angle``, counter-clockwise seen from above."""
    x = torch.zeros(1, 4, 144, 144)
    for t in torch.linspace(-45, 45, 400):
        # Rows grow towards -y.
        x[0, 3, round(float(71.5 - t * math.sin(angle))), round(float(71.5 + t * math.cos(angle)))] = 1
    return x


@pytest.mark.parametrize("k", range(16))
def test_the_turn_makes_its_own_angle_horizontal(k: int) -> None:
    rows = [(image[3].sum(1) > 0).sum().item() for image in _all(GRASP, _bar(k * math.pi / 16))]
    assert min(rows) == rows[k]
    assert rows[k] <= 3
    assert all(rows[j] > 10 for j in range(16) if j != k)


def test_no_part_of_the_bin_is_cut_off() -> None:
    for corner in ((0, 0), (0, 143), (143, 0), (143, 143)):
        x = torch.zeros(1, 4, 144, 144)
        x[0, 3, max(0, corner[0] - 2) : corner[0] + 3, max(0, corner[1] - 2) : corner[1] + 3] = 1
        assert all(turned[3].sum() >= 5 for turned in _all(GRASP, x))


def test_a_canvas_is_no_larger_than_its_angle_needs() -> None:
    sides = [height for height, width in GRASP.canvases if height == width]
    assert sides == [144, 172, 192, 200, 204, 200, 192, 172] * 2
    assert GRASP.largest == (204, 204)
    seen = [k.tolist() for _, k in GRASP.by_canvas(2)]
    assert sorted(k for some in seen for k in some) == list(range(16))
    assert max(map(len, seen)) == 2


def test_a_network_that_sees_further_than_a_canvas_has_the_same_for_all_angles() -> None:
    assert Rotations((144, 144), 16, 32, receptive_radius=512).canvases == [(224, 224)] * 16
    assert Rotations((100, 144), 1, 4, receptive_radius=48).canvases == [(100, 144)]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 15), st.integers(2, 141), st.integers(2, 141))
def test_rotate_and_back(k: int, row: int, col: int) -> None:
    x = torch.zeros(1, 4, 144, 144)
    x[0, 3, row - 1 : row + 2, col - 1 : col + 2] = 1
    angle = torch.tensor([k])
    turned = GRASP.turned(x, angle, GRASP.canvases[k])
    assert GRASP.back(turned[:, 3:], angle)[0, row, col] == 1
    i, j = GRASP.locate(angle, torch.tensor([row]), torch.tensor([col]))
    assert turned[0, 3, i, j] == 1


@pytest.mark.parametrize("shape", [(144, 144), (145, 142), (143, 145)])
@pytest.mark.parametrize("count", [1, 16])
def test_the_first_angle_changes_nothing(shape: tuple[int, int], count: int) -> None:
    rotations = Rotations(shape, count, 4, receptive_radius=48)
    x = torch.randn(1, 4, *shape)
    first = torch.tensor([0])
    turned = rotations.turned(x, first, rotations.canvases[0])
    back = torch.cat([rotations.back(turned[:, i : i + 1], first) for i in range(4)])
    assert torch.allclose(back, x[0], atol=1e-3)  # bilinear weights are 1 but for rounding


@pytest.mark.parametrize("shape", [(144, 144), (145, 143)])
def test_a_window_of_odd_heightmaps_is_the_canvas_there(shape: tuple[int, int]) -> None:
    rotations = Rotations(shape, 16, 4, receptive_radius=8)
    x = torch.randn(16, 4, *shape)
    angle, row, col = torch.arange(16), torch.arange(16) * 4 + 40, torch.arange(16) * 3 + 50
    window, rows, cols = rotations.window(x, angle, row, col)
    all_of_it, whole_rows, whole_cols = rotations.window(x, angle, row, col, whole=True)
    i, j = rotations.locate(angle, row, col)
    for k, canvas in enumerate(rotations.canvases):
        turned = rotations.turned(x[k : k + 1], angle[k : k + 1], canvas)[0]
        # Colour; of two heights equally near either may be taken.
        assert torch.allclose(window[k, :3, rows[k], cols[k]], turned[:3, i[k], j[k]], atol=1e-3)
        assert torch.allclose(all_of_it[k, :3, whole_rows[k], whole_cols[k]], turned[:3, i[k], j[k]], atol=1e-3)


def test_resampling_agrees_with_an_exact_quarter_turn() -> None:
    x = torch.randn(1, 1, 32, 32)
    grid = sampling_grid(torch.tensor([math.pi / 2]), (32, 32), (32, 32))
    # What points along +y (up) must become horizontal (to the right): a clockwise quarter turn of the image.
    assert torch.equal(warp_nearest(x, grid), torch.rot90(x, -1, (2, 3)))


def test_windows_stay_on_the_canvas_and_hold_their_pixel() -> None:
    x = torch.randn(4, 4, 144, 144)
    angle, row, col = torch.tensor([0, 5, 8, 15]), torch.tensor([0, 143, 70, 3]), torch.tensor([143, 0, 70, 99])
    windows, i, j = GRASP.window(x, angle, row, col)
    rows, cols = GRASP.locate(angle, row, col)
    assert windows.shape[2:] == (100, 100)
    for n, k in enumerate(angle):
        turned = GRASP.turned(x[n : n + 1], k[None], GRASP.canvases[k])[0]
        corner = int(rows[n] - i[n]), int(cols[n] - j[n])
        there = turned[:, corner[0] : corner[0] + 100, corner[1] : corner[1] + 100]
        assert there.shape == windows[n].shape
        assert torch.allclose(windows[n, :3], there[:3], atol=1e-3)
        assert (windows[n, 3] == there[3]).float().mean() > 0.999  # of two heights equally near either may be taken
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
    window, i, j = GRASP.window(x, angle, row, col, torch.tensor([turn]))
    assert window[0, 3, i - 1 : i + 2, j].max() == 1
    assert (window[0, 3].sum(1) > 0).sum() <= 4
    plain, *_ = GRASP.window(x, angle, row, col)
    assert (plain[0, 3].sum(1) > 0).sum() > 4 or abs(turn) > 3


def test_a_window_is_shifted_along_the_canvas() -> None:
    suction = Rotations((144, 144), 1, 4, receptive_radius=48)
    x = torch.randn(1, 4, 144, 144)
    pixel = torch.tensor([0]), torch.tensor([60]), torch.tensor([80])
    window, i, j = suction.window(x, *pixel, None, torch.tensor([[2.0, -3.0]]))
    assert torch.allclose(window[0, :, i.item(), j.item()], x[0, :, 62, 77], atol=1e-3)
    assert torch.allclose(window[0, :, i.item() + 5, j.item() + 7], x[0, :, 67, 84], atol=1e-3)
