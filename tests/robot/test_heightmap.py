from __future__ import annotations

import numpy as np
import pytest

from see2act.robot import heightmap as hm
from see2act.robot.types import RobotError
from see2act.robot.workspace import Workspace

BIN = Workspace("bin", 0.36, 0.36, 0.0025)


def _cloud(n: int, low: float, high: float, z: float) -> np.ndarray:
    side = np.linspace(low, high, n)
    x, y = np.meshgrid(side, side)
    return np.stack([x, y, np.full_like(x, z)], axis=-1)


def _project(points: np.ndarray) -> hm.Heightmap:
    shape = points.shape[:2]
    return hm.project(np.full((*shape, 3), 200, np.uint8), np.ones(shape, np.float32), points, BIN)


def test_the_highest_point_of_a_cell_wins() -> None:
    points = np.concatenate([_cloud(400, -0.2, 0.2, 0.05), _cloud(400, -0.2, 0.2, 0.01)])
    heightmap = _project(points)
    assert heightmap.valid.all()
    assert np.allclose(heightmap.height, 0.05)


def test_a_point_lands_in_the_cell_of_its_pixel() -> None:
    points = np.concatenate([_cloud(400, -0.2, 0.2, 0.0), _cloud(400, 0.05, 0.06, 0.04)])
    heightmap = _project(points)
    rows, cols = np.nonzero(heightmap.height > 0.02)
    xs, ys = zip(*(BIN.to_world(r, c) for r, c in zip(rows, cols, strict=True)), strict=True)
    assert np.allclose([min(xs), max(xs), min(ys), max(ys)], [0.05, 0.06, 0.05, 0.06], atol=BIN.pixel)


def test_cracks_take_the_nearest_value_and_hidden_space_is_floor() -> None:
    """A block at the upper right and a patch of floor at the lower left: what lies between was not seen."""
    points = np.concatenate([_cloud(200, 0.0, 0.18, 0.05), _cloud(200, -0.18, -0.15, 0.001)])
    heightmap = _project(points)
    row, col = (int(i) for i in BIN.to_pixel(np.array(0.05), np.array(0.001)))
    assert heightmap.valid[row, col]
    assert not heightmap.valid[row + 2, col]
    assert heightmap.height[row + 2, col] == pytest.approx(0.05)
    assert not heightmap.valid[row + 6, col]
    assert heightmap.height[row + 6, col] == pytest.approx(0.001)
    assert (heightmap.color == 200).all()


def test_nan_depth_is_refused() -> None:
    depth = np.ones((4, 4), np.float32)
    depth[0, 0] = np.nan
    with pytest.raises(RobotError, match="1 values that are not finite"):
        hm.project(np.zeros((4, 4, 3), np.uint8), depth, np.zeros((4, 4, 3)), BIN)


def test_depth_in_the_wrong_unit_is_refused() -> None:
    with pytest.raises(RobotError, match="depth unit"):
        _project(_cloud(10, 600, 700, 5.0))


@pytest.mark.parametrize(("row", "col"), [(-1, 0), (0, -1), (144, 0), (0, 144)])
def test_a_pixel_outside_is_refused(row: int, col: int) -> None:
    with pytest.raises(RobotError, match=rf"pixel \({row}, {col}\) lies outside the 144 x 144 heightmap"):
        BIN.pick(_project(_cloud(400, -0.2, 0.2, 0.0)), row, col, 0.0)
