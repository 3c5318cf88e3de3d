import pytest
from hypothesis import given
from hypothesis import strategies as st

from see2act.robot.types import RobotError
from see2act.robot.workspace import Workspace

BIN = Workspace("bin", 0.36, 0.30, 0.0025)


@given(st.integers(0, 119), st.integers(0, 143))
def test_pixel_to_world_and_back(row: int, col: int) -> None:
    assert BIN.shape == (120, 144)
    x, y = BIN.to_world(row, col)
    assert tuple(int(i) for i in BIN.to_pixel(x, y)) == (row, col)


def test_rows_grow_towards_minus_y_and_columns_towards_x() -> None:
    assert BIN.to_world(0, 0) == pytest.approx((-0.17875, 0.14875))
    assert BIN.to_world(119, 143) == pytest.approx((0.17875, -0.14875))


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(RobotError, match="must be positive"):
        Workspace("bin", 0.36, 0.36, -0.1)
    with pytest.raises(RobotError, match=r"workspace.length=0\.36 is 102\.86 pixels of 0\.0035 m: give 0\.3605"):
        Workspace("bin", 0.35, 0.36, 0.0035)
