"""From unboxing to a dry run: the commands of `real.py`, in their order, at a station without hardware."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.stand_in.cell import BRACKET, StandInCell
from benchmarks.stand_in.person import Person
from see2act.commands.demo import main as demo
from see2act.commands.real import main
from see2act.robot.real import cell as cells
from see2act.robot.real import station as stations
from see2act.robot.real.operator import Terminal
from see2act.robot.real.setup import calibrate
from see2act.robot.real.station import Station
from see2act.robot.types import RobotError
from tests.robot.real.conftest import WORKER

HOST = f"127.{WORKER}.98.1"
NEW = ("new", "--host", HOST, "--tool", "vacuum_io", "--tip", "0.14")


class Step(NamedTuple):
    """A station after one of the commands."""

    path: Path
    said: str

    @property
    def station(self) -> Station:
        return stations.load(self.path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("unboxed")


@pytest.fixture(scope="module")
def cell(folder: Path) -> Iterator[StandInCell]:
    cell = StandInCell(HOST, folder, unboxed=True)
    yield cell
    cells.disconnect()
    cell.close()


@pytest.fixture(scope="module")
def person(cell: StandInCell) -> Iterator[Person]:
    """Answers at the terminal. Speeds and counts are those of a test, not of a robot."""
    person = Person(cell)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Terminal, "ask", lambda self, request: person.ask(request))
        patch.setattr(calibrate, "SPEED", 1.0)
        patch.setattr(calibrate, "REST", 0.1)
        patch.setattr(calibrate, "WANTED", 16)
        yield person


@pytest.fixture(scope="module")
def new(folder: Path, person: Person) -> Step:
    return done(None, folder / "new.yaml", *NEW)


@pytest.fixture(scope="module")
def taught(new: Step) -> Step:
    copy = new.path.with_name("taught.yaml")
    copy.write_text(new.path.read_text().replace(f"host: {HOST}", f"host: {HOST}  # ours"))
    return done(copy, copy, "teach")


@pytest.fixture(scope="module")
def calibrated(taught: Step) -> Step:
    return done(taught.path, taught.path.with_name("calibrated.yaml"), "calibrate", "--centre", *map(str, BRACKET))


@pytest.fixture(scope="module")
def touched(calibrated: Step) -> Step:
    return done(calibrated.path, calibrated.path.with_name("touched.yaml"), "touch")


@pytest.fixture(scope="module")
def ready(touched: Step) -> Step:
    return done(touched.path, touched.path.with_name("station.yaml"), "background")


def done(before: Path | None, path: Path, *command: str) -> Step:
    """Type a command at a copy of the station."""
    if before is not None and before != path:
        shutil.copy(before, path)
    said = io.StringIO()
    with redirect_stdout(said):
        typed(path, *command)
    return Step(path, said.getvalue())


def typed(path: Path, command: str, *more: str) -> None:
    main([command, "--station", str(path), *more, *(configured(path) if command not in ("new", "teach") else [])])


def configured(path: Path) -> list[str]:
    camera = ["camera=files", f"camera.folder={path.parent}/camera", "camera.frames=1"]
    return [*camera, "robot.tool_speed=1.0", "robot.descent_speed=1.0", "robot.joint_speed=3.0"]


def checked(step: Step) -> dict[str, tuple[str, str]]:
    said = io.StringIO()
    with redirect_stdout(said), suppress(SystemExit):
        typed(step.path, "check", "--json")
    return {line["part"]: (line["verdict"], line["text"]) for line in json.loads(said.getvalue())}


def views(step: Step) -> list[Path]:
    return list(step.path.parent.glob("calibration-*.npz"))


def test_new_writes_a_station_that_can_be_read(new: Step) -> None:
    assert new.station.robot.host == HOST
    assert new.station.tool.kind == "vacuum_io"
    assert "# Address of the controller." in new.path.read_text()


def test_new_does_not_overwrite(new: Step) -> None:
    before = new.path.read_text()
    with pytest.raises(SystemExit, match="is there already"):
        typed(new.path, *NEW)
    assert new.path.read_text() == before


def test_check_says_what_is_to_be_done(new: Step, cell: StandInCell) -> None:
    before = cell.moves()
    found = checked(new)
    assert found["home"] == ("to do", "type `python real.py teach`")
    assert found["calibration"] == ("to do", "type `python real.py calibrate`")
    assert found["controller"][0] == "ok"
    assert "running" in found["controller"][1]
    assert found["camera"][0] == "ok"
    assert cell.moves() == before


@pytest.mark.parametrize("command", ["calibrate", "touch", "background"])
def test_a_command_names_the_one_before_it(new: Step, command: str) -> None:
    with pytest.raises(SystemExit, match=r"real\.py teach"):
        typed(new.path, command)


def test_teach_keeps_the_places(taught: Step) -> None:
    assert taught.station.robot.home is not None
    assert taught.station.robot.drop is not None
    assert "# ours" in taught.path.read_text()
    assert "mm deep" in taught.said
    assert taught.station.world()[2, 2] == pytest.approx(1)


def test_calibrate_finds_the_camera(calibrated: Step, cell: StandInCell, tmp_path: Path) -> None:
    calibration = calibrated.station.calibration
    assert calibration is not None
    assert calibration.views >= 12
    assert cell.error(np.array(calibration.camera)) < 0.002
    assert "good" in calibrated.said
    assert len(views(calibrated)) == 1
    again = done(calibrated.path, tmp_path / "station.yaml", "calibrate", "--views", str(views(calibrated)[0]))
    assert again.station.calibration is not None
    assert again.station.calibration.camera == calibration.camera


def test_touch_ends_the_slow_speed(calibrated: Step, touched: Step, person: Person) -> None:
    assert not calibrated.station.trusted
    assert touched.station.trusted
    assert sum(request.startswith("Point") for request in person.asked) == 5


def test_background_sees_the_floor_where_it_was_taught(ready: Step) -> None:
    assert ready.station.background
    assert (ready.path.parent / ready.station.background).is_file()
    assert "warning" not in ready.said


def test_check_is_content_in_the_end(ready: Step) -> None:
    found = checked(ready)
    assert {part for part, (verdict, _) in found.items() if verdict != "ok"} == set()
    assert "reach" in found
    assert "vacuum_io" in found


def test_another_calibration_wants_another_touch_test(touched: Step, tmp_path: Path) -> None:
    again = done(touched.path, tmp_path / "station.yaml", "calibrate", "--views", str(views(touched)[0]))
    assert again.station.touch is None


def test_a_bin_out_of_reach_is_refused_before_anything_moves(ready: Step, cell: StandInCell) -> None:
    before, station = cell.moves(), ready.station
    assert station.bin is not None
    far = tuple((x - 0.6, y, z) for x, y, z in station.bin)
    path = ready.path.with_name("far.yaml")
    stations.save(Station.model_validate({**station.model_dump(), "bin": far}), path)
    with pytest.raises(SystemExit, match="cannot reach"):
        typed(path, "touch")
    assert cell.moves() == before


def test_corners_of_no_rectangle_are_refused(ready: Step, cell: StandInCell, monkeypatch: pytest.MonkeyPatch) -> None:
    text, lead = ready.path.read_text(), cell.lead
    monkeypatch.setattr(cell, "lead", lambda place: lead("home" if place == "far left" else place))
    with pytest.raises(SystemExit, match="not those of a rectangle"):
        typed(ready.path, "teach", "--places", "bin")
    assert ready.path.read_text() == text


def test_a_file_that_holds_no_views_is_refused(ready: Step, tmp_path: Path) -> None:
    wrong = tmp_path / "views.npz"
    np.savez(wrong, other=np.zeros(3))
    with pytest.raises(SystemExit, match="holds no views"):
        typed(ready.path, "calibrate", "--views", str(wrong))


def test_demo_hovers_above_its_picks(ready: Step, tmp_path: Path) -> None:
    overrides = ["robot=ur5_real", f"robot.station={ready.path}", "primitive=suction", "evaluate.attempts.unseen=2"]
    demo([*overrides, *configured(ready.path), "--dry-run", "--out", str(tmp_path)])
    assert list(tmp_path.glob("*/strip.png"))


def test_a_station_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "station.yaml").write_text("robot: [\n")
    with pytest.raises(RobotError, match="is no YAML"):
        stations.load(tmp_path / "station.yaml")
