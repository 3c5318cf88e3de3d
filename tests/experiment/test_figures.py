from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import pytest

from see2act.experiment import charts, figures
from see2act.experiment.attempts import AttemptRow
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Pick
from tests.factory import attempt_row


def _row(step: int, score: float, success: int, **more: Any) -> AttemptRow:
    return attempt_row(step=step, score=score, success=bool(success), cause="ok" if success else "missed", **more)


def test_reliability_counts_by_tenths_of_the_prediction() -> None:
    rows = [_row(i, 0.31 + 0.02 * i, i % 2) for i in range(4)] + [_row(9, 1.0, 1)]
    (predicted, observed, low, high), sure = charts._reliability(rows)
    assert predicted == pytest.approx(0.34)
    assert observed == 0.5
    assert 0 < low < 0.5 < high < 1
    assert sure[:2] == (1.0, 1.0)


def test_repeats_are_within_an_episode_and_after() -> None:
    rows = [_row(1, 0.5, 0, episode=0, x=0.1, y=0.0), _row(2, 0.5, 0, episode=0, x=0.107, y=-0.007)]
    rows.append(_row(3, 0.5, 0, episode=1, x=0.1, y=0.0))
    assert [charts._near_earlier(row, rows) for row in rows] == [False, True, False]


def test_calibration_is_that_of_one_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        _row(step, 0.5, 1, phase=phase, policy=policy)
        for phase, step, policy in (("zero_shot", 0, "suppress"), ("eval", 5, "suppress"), ("eval", 5, "argmax"))
        for _ in range(7)
    ]
    rows += [_row(i + 1, 0.5, 0) for i in range(5)]
    counted: list[int] = []
    monkeypatch.setattr(charts, "_reliability", lambda rows: counted.append(len(rows)) or [])
    charts.diagnosis(rows, tmp_path / "diagnosis.png", "a run")
    assert counted == [7, 5, 7]


@pytest.mark.parametrize("learned", [0, 45])
def test_learning_is_diagnosed_also_where_all_attempts_end_alike(tmp_path: Path, learned: int) -> None:
    rows = [_row(step, 0.07 * i, 1, phase=phase) for step, phase in ((0, "zero_shot"), (learned, "eval")) for i in range(15)]
    rows += [_row(i + 1, 0.02 * i, 0, episode=i // 10) for i in range(learned)]
    charts.diagnosis(rows, tmp_path / "diagnosis.png", "a run")
    assert (tmp_path / "diagnosis.png").stat().st_size > 10_000


def test_failures_keep_no_more_than_is_shown() -> None:
    failures = figures.Failures()
    for cause in ["missed"] * 9 + ["wall"]:
        failures.add(SimpleNamespace(outcome=SimpleNamespace(cause=cause)))  # type: ignore[arg-type]
    assert failures.counts == {"missed": 9, "wall": 1}
    assert {cause: len(shown) for cause, shown in failures.shown.items()} == {"missed": figures.SHOWN, "wall": 1}


@pytest.mark.parametrize(("primitive", "millimetres"), [("grasp", 86), ("grasp_rg2", 110), ("suction", None)])
def test_the_line_of_a_grasp_is_as_long_as_its_gripper_opens(
    make_robot: Callable[..., SimulatedRobot], primitive: str, millimetres: int | None
) -> None:
    robot = make_robot(f"primitive={primitive}")
    heightmap = robot.background()
    _, axis = plt.subplots()
    figures._picture(axis, heightmap, Pick(30, 20, math.pi / 4, 0.0, 0.0, 0.0), robot, "")
    lines = [line.get_xydata() for line in axis.lines if len(line.get_xydata()) == 2]
    assert len(lines) == (millimetres is not None)
    if millimetres:
        (x0, y0), (x1, y1) = lines[0]
        length = math.hypot(x1 - x0, y1 - y0) * robot.workspace.pixel * 1000
        assert length == pytest.approx(millimetres, abs=2)
        assert (x1 > x0) == (y1 < y0)  # up in the image is y of the world
