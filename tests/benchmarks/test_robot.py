"""Small samples of the long measurements; the full tables are made by command (docs/robot.md)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import arm, clutter, determinism, sensing, validity

pytestmark = pytest.mark.slow
PRIMITIVES = ["suction", "grasp"]


def test_a_tool_without_a_target_is_measured_all_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    row = {"primitive": "grasp_rg2", "policy": "oracle", "split": "seen", "rate": 0.9, "objects": {}}
    monkeypatch.setattr(validity, "spread", lambda *_: [dict(row)])
    monkeypatch.setattr(sys, "argv", ["validity", "--primitives", "grasp_rg2", "--json", str(tmp_path / "rows.json")])
    validity.main()
    assert json.loads((tmp_path / "rows.json").read_text())[0]["met"] is None


def test_a_misspelt_override_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["determinism", "objects=foo"])
    with pytest.raises(SystemExit):
        determinism.main()
    assert "foo" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("split", ["seen", "unseen"])
def test_a_full_bin_is_cluttered_still_and_apart(split: str) -> None:
    for scene in clutter.measure([], split, 1000, 3):
        for name, (least, most) in clutter.TARGETS.items():
            assert least <= scene[name] <= most, (name, scene)


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_the_arm_reaches_every_pose_exactly(primitive: str) -> None:
    rows = arm.reach([], primitive, 36)
    assert len(rows) == 4
    assert all(row["met"] for row in rows), rows


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_tools_stop_at_walls_and_the_arm_touches_nothing(primitive: str) -> None:
    rows = arm.walls([], primitive, 12)
    assert [row for row in rows if not row["met"]] == []
    assert next(row["worst"] for row in rows if "stopped" in row["name"]) > 0


@pytest.mark.parametrize("primitive", PRIMITIVES)
@pytest.mark.parametrize("kind", ["edge", "knocked"])
def test_what_is_sensed_is_true(primitive: str, kind: str) -> None:
    row = sensing.measure([], primitive, kind, 1000, 12)
    assert row["attempts"] == 12
    # Processors differ in the last bits of the physics, so the twelve picks are not the same everywhere, and about one grasp at
    # an edge in 90 is sensed wrongly (docs/robot.md). The command checks the limit on the rate, which needs hundreds of picks.
    assert row["false_positives"] + row["false_negatives"] <= 1


def test_busy_cores_change_nothing() -> None:
    row = determinism.compare([], "grasp", 2)
    assert row["identical"] == row["picks"] == 10


def test_an_oracle_picks_and_a_random_pixel_does_not() -> None:
    oracle = validity.measure([], "suction", "unseen", "oracle", "develop", 10)
    chance = validity.measure([], "suction", "unseen", "random", "develop", 10)
    assert oracle["attempts"] >= 10
    assert oracle["rate"] >= 0.8 > 0.5 >= chance["rate"]
    assert sum(n for _, n in oracle["objects"].values()) == oracle["attempts"]
    assert oracle["objects"].get("floor", (0, 0))[0] == 0


def test_the_models_that_are_shipped_pick() -> None:
    row = validity.measure([], "suction", "unseen", "trained", "develop", 10)
    assert row["rate"] >= 0.8
    assert row["objects"] == {}
