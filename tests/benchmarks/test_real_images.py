from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import real_images
from benchmarks.real_images import KNOWN, hit, outlined, prepare, score, totals
from see2act.errors import UserError


def test_an_outline_within_an_outline_is_a_hole_and_later_objects_lie_above() -> None:
    ring = [[[10, 10], [50, 10], [50, 50], [10, 50]], [[20, 20], [40, 20], [40, 40], [20, 40]]]
    bar = [[[0, 44], [60, 44], [60, 47], [0, 47]]]
    mask = outlined([ring, bar], (60, 80))
    assert (mask[15, 15], mask[30, 30], mask[45, 30], mask[45, 70]) == (1, 0, 2, 0)


def test_a_pick_counts_on_an_object_and_just_beside_it() -> None:
    mask = np.zeros((40, 60), np.uint8)
    mask[10:20, 10:20], mask[10:20, 20:30] = 2, 1
    assert hit([(15, 15), (19, 12), (32, 15), (34, 15), (50, 35)], mask).tolist() == [2, 2, 1, 0, 0]
    assert hit([], mask).size == 0


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene with two objects, and three picks in it: two on the first and one on none."""
    folder = tmp_path / "scenes" / "mine"
    folder.mkdir(parents=True)
    mask = np.zeros((40, 60), np.uint8)
    mask[:10], mask[30:] = 1, 2
    cv2.imwrite(str(folder / "objects.png"), mask)
    (folder / "scene.json").write_text(json.dumps({"depth_scale": 1000, "source": "here", "half": "develop"}))
    picks = tmp_path / "picks" / "mine" / "suction"
    picks.mkdir(parents=True)
    found = [{"u": 5, "v": 5}, {"u": 50, "v": 5}, {"u": 30, "v": 20}]
    (picks / "picks.json").write_text(json.dumps({"picks": found}))
    return folder


def test_picks_of_any_version_are_counted(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, table = scene.parents[1] / "picks", scene.parents[1] / "rows.json"
    words = ["real_images", str(scene.parent), "--out", str(out), "--score", "--json", str(table)]
    monkeypatch.setattr(sys, "argv", words)
    real_images.main()
    rows = json.loads(table.read_text())
    suction = next(row for row in rows if row["scene"] == "mine" and row["primitive"] == "suction")
    told = ("picks", "on_objects", "first_on_object", "objects_picked", "objects", "share")
    assert [suction[name] for name in told] == [3, 2, True, 1, 2, "0.67"]
    grasp = next(row for row in rows if row["scene"] == "mine" and row["primitive"] == "grasp")
    assert (grasp["picks"], grasp["share"]) == (0, "no picks")
    assert {row["share"] for row in rows if row["source"] == "all"} == {"0.67 [0.21, 0.94]", "no picks"}
    assert "Picks on objects" in capsys.readouterr().out


def test_totals_are_sums_over_a_source_and_a_half(scene: Path) -> None:
    one = score(scene, scene.parents[1] / "picks" / "mine" / "suction", "suction")
    other = one | {"source": "there", "picks": 10, "on_objects": 10}
    found = {(row["source"], row["half"]): row["picks"] for row in totals([one, other]) if row["primitive"] == "suction"}
    assert found == {("here", ""): 3, ("there", ""): 10, ("", "develop"): 13, ("all", ""): 13}


def test_public_files_become_scenes(tmp_path: Path) -> None:
    """With files of the same form, which are ours."""
    known = json.loads(KNOWN.read_text())["scenes"]
    table = known["robot-table"]
    clone = tmp_path / "clone"
    for name in ("cheezit", "blue-mug"):
        path = clone / known[name]["data"]
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = np.where(np.arange(640) < 9, np.nan, np.full((480, 640), 0.51234)).astype(np.float32)
        image = np.full((480, 640, 3), (200, 100, 50), np.uint8)
        np.save(path, np.array({"image": image, "depth": depth, "intrinsics_matrix": np.eye(3)}), allow_pickle=True)
    assert table["source"] == "graspnet-baseline"
    known = {name: scene for name, scene in known.items() if name in ("cheezit", "blue-mug")}
    listed = tmp_path / "known.json"
    listed.write_text(json.dumps(json.loads(KNOWN.read_text()) | {"scenes": known}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(real_images, "KNOWN", listed)
        prepare(tmp_path / "scenes", {"6dof-graspnet": clone})
    assert sorted(path.name for path in (tmp_path / "scenes").iterdir()) == ["blue-mug", "cheezit"]
    made = tmp_path / "scenes" / "cheezit"
    depth = cv2.imread(str(made / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert (depth[0, 0], depth[0, 100]) == (0, 5123)
    assert cv2.imread(str(made / "color.png"))[0, 0].tolist() == [50, 100, 200]
    assert cv2.imread(str(made / "objects.png"), cv2.IMREAD_UNCHANGED).max() == 1
    assert json.loads((made / "scene.json").read_text())["half"] == "reported"
    with pytest.raises(UserError, match="--clone nowhere is not known"):
        prepare(tmp_path / "scenes", {"nowhere": clone})


def test_a_file_that_calls_something_is_not_read(tmp_path: Path) -> None:
    class Call:
        def __reduce__(self) -> tuple:
            return print, ("called",)

    np.save(tmp_path / "bad.npy", np.array({"image": Call()}), allow_pickle=True)
    with pytest.raises(UserError, match=r"calls builtins\.print"):
        real_images._pickled(tmp_path / "bad.npy")


def test_every_outline_lies_in_its_image() -> None:
    known = json.loads(KNOWN.read_text())
    assert len(known["scenes"]) == 14
    halves = [scene["half"] for scene in known["scenes"].values()]
    assert halves.count("develop") == halves.count("reported") == 7
    for name, scene in known["scenes"].items():
        assert scene["source"] in known["sources"]
        size = (1280, 720) if name == "robot-table" else (640, 480)
        corners = np.array([corner for polygons in scene["objects"].values() for polygon in polygons for corner in polygon])
        assert corners.min() >= 0
        assert (corners <= size).all()
