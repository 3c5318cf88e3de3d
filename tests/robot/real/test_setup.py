"""From unboxing to a dry run: the commands of `real.py`, in their order, at a station without hardware."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stand_in.cell import BRACKET, StandInCell
from benchmarks.stand_in.person import Person
from see2act.commands.real import main
from see2act.robot.real import cell as cells
from see2act.robot.real import station as stations
from see2act.robot.real.operator import Terminal
from see2act.robot.real.setup import calibrate
from see2act.robot.real.station import Station
from see2act.robot.types import RobotError
from tests.robot.real.conftest import WORKER

HOST = f"127.{WORKER}.98.1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("unboxed")


@pytest.fixture(scope="module")
def cell(folder: Path) -> Iterator[StandInCell]:
    cell = StandInCell(HOST, folder, unboxed=True)
    yield cell
    cells.disconnect()
    cell.close()


@pytest.fixture
def person(cell: StandInCell, monkeypatch: pytest.MonkeyPatch) -> Person:
    person = Person(cell)
    monkeypatch.setattr(Terminal, "ask", lambda self, request: person.ask(request))
    return person


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibrate, "SPEED", 1.0)
    monkeypatch.setattr(calibrate, "REST", 0.1)
    monkeypatch.setattr(calibrate, "WANTED", 16)


@pytest.fixture
def path(folder: Path) -> Path:
    return folder / "station.yaml"


def typed(path: Path, command: str, *more: str) -> None:
    main([command, "--station", str(path), *more, *(configured(path) if command not in ("new", "teach") else [])])


def configured(path: Path) -> list[str]:
    camera = ["camera=files", f"camera.folder={path.parent}/camera", "camera.frames=1"]
    return [*camera, "robot.tool_speed=1.0", "robot.descent_speed=1.0", "robot.joint_speed=3.0"]


def checked(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, tuple[str, str]]:
    capsys.readouterr()
    with suppress(SystemExit):
        typed(path, "check", "--json")
    return {line["part"]: (line["verdict"], line["text"]) for line in json.loads(capsys.readouterr().out)}


def test_new_writes_a_station_that_can_be_read(path: Path, person: Person) -> None:
    typed(path, "new", "--host", HOST, "--tool", "vacuum_io", "--tip", "0.14")
    station = stations.load(path)
    assert station.robot.host == HOST
    assert station.tool.kind == "vacuum_io"
    assert "# Address of the controller." in path.read_text()


def test_new_does_not_overwrite(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = path.read_text()
    with pytest.raises(SystemExit, match="is there already"):
        typed(path, "new", "--host", HOST, "--tool", "vacuum_io", "--tip", "0.14")
    assert path.read_text() == before


def test_check_says_what_is_to_be_done(
    path: Path, person: Person, cell: StandInCell, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cell.moves()
    found = checked(path, capsys)
    assert found["home"] == ("to do", "type `python real.py teach`")
    assert found["calibration"] == ("to do", "type `python real.py calibrate`")
    assert found["controller"][0] == "ok"
    assert "running" in found["controller"][1]
    assert found["camera"][0] == "ok"
    assert cell.moves() == before


@pytest.mark.parametrize(("command", "first"), [("calibrate", "teach"), ("touch", "teach"), ("background", "teach")])
def test_a_command_names_the_one_before_it(path: Path, person: Person, command: str, first: str) -> None:
    with pytest.raises(SystemExit, match=f"real.py {first}"):
        typed(path, command)


def test_teach_keeps_the_places(path: Path, person: Person, capsys: pytest.CaptureFixture[str]) -> None:
    path.write_text(path.read_text().replace(f"host: {HOST}", f"host: {HOST}  # ours"))
    typed(path, "teach")
    station = stations.load(path)
    assert station.robot.home is not None
    assert station.robot.drop is not None
    assert "# ours" in path.read_text()
    assert "mm deep" in capsys.readouterr().out
    assert station.world()[2, 2] == pytest.approx(1)


def test_calibrate_finds_the_camera(path: Path, person: Person, cell: StandInCell, capsys: pytest.CaptureFixture[str]) -> None:
    typed(path, "calibrate", "--centre", *map(str, BRACKET))
    calibration = stations.load(path).calibration
    assert calibration is not None
    assert calibration.views >= 12
    assert cell.error(np.array(calibration.camera)) < 0.002
    assert "good" in capsys.readouterr().out
    kept = list(path.parent.glob("calibration-*.npz"))
    assert len(kept) == 1
    typed(path, "calibrate", "--views", str(kept[0]))
    again = stations.load(path).calibration
    assert again is not None
    assert again.camera == calibration.camera


def test_touch_ends_the_slow_speed(path: Path, person: Person) -> None:
    assert not stations.load(path).trusted
    typed(path, "touch")
    station = stations.load(path)
    assert station.trusted
    assert sum(request.startswith("Point") for request in person.asked) == 5


def test_background_sees_the_floor_where_it_was_taught(path: Path, person: Person, capsys: pytest.CaptureFixture[str]) -> None:
    typed(path, "background")
    station = stations.load(path)
    assert station.background
    assert (path.parent / station.background).is_file()
    assert "warning" not in capsys.readouterr().out


def test_check_is_content_in_the_end(path: Path, person: Person, capsys: pytest.CaptureFixture[str]) -> None:
    found = checked(path, capsys)
    assert {part for part, (verdict, _) in found.items() if verdict != "ok"} == set()
    assert "reach" in found
    assert "vacuum_io" in found


def test_another_calibration_wants_another_touch_test(path: Path, person: Person) -> None:
    before = path.read_text()
    typed(path, "calibrate", "--views", str(next(path.parent.glob("calibration-*.npz"))))
    assert stations.load(path).touch is None
    path.write_text(before)


def test_a_bin_out_of_reach_is_refused_before_anything_moves(path: Path, person: Person, cell: StandInCell) -> None:
    before, text = cell.moves(), path.read_text()
    station = stations.load(path)
    assert station.bin is not None
    far = tuple((x - 0.6, y, z) for x, y, z in station.bin)
    stations.save(Station.model_validate({**station.model_dump(), "bin": far}), path)
    try:
        with pytest.raises(SystemExit, match="cannot reach"):
            typed(path, "touch")
    finally:
        path.write_text(text)
    assert cell.moves() == before


def test_corners_of_no_rectangle_are_refused(path: Path, person: Person, cell: StandInCell) -> None:
    text = path.read_text()
    lead = cell.lead
    cell.lead = lambda place: lead("home" if place == "far left" else place)  # type: ignore[method-assign]
    try:
        with pytest.raises(SystemExit, match="not those of a rectangle"):
            typed(path, "teach", "--places", "bin")
    finally:
        del cell.lead  # type: ignore[method-assign]
    assert path.read_text() == text


def test_a_file_that_holds_no_views_is_refused(path: Path, tmp_path: Path, person: Person) -> None:
    wrong = tmp_path / "views.npz"
    np.savez(wrong, other=np.zeros(3))
    with pytest.raises(SystemExit, match="holds no views"):
        typed(path, "calibrate", "--views", str(wrong))


def test_demo_hovers_above_its_picks(path: Path, person: Person, cell: StandInCell, tmp_path: Path) -> None:
    from see2act.commands.demo import main as demo

    overrides = [
        "robot=ur5_real",
        f"robot.station={path}",
        "primitive=suction",
        "evaluate.attempts.unseen=2",
        *configured(path),
    ]
    demo([*overrides, "--dry-run", "--out", str(tmp_path)])
    assert list(tmp_path.glob("*/strip.png"))


def test_a_station_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "station.yaml").write_text("robot: [\n")
    with pytest.raises(RobotError, match="is no YAML"):
        stations.load(tmp_path / "station.yaml")
