"""The whole station without hardware: the robot through the real client, a stand-in controller, and the simulated scene."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate

from benchmarks.stand_in.cell import StandInCell
from benchmarks.stand_in.person import Person
from see2act.errors import ConfigError
from see2act.experiment.checks import check_run
from see2act.experiment.config import composed
from see2act.robot.oracle import oracle
from see2act.robot.real import cell as cells
from see2act.robot.real import station as stations
from see2act.robot.real.operator import Operator
from see2act.robot.real.robot import RealRobot
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Pick, RobotError

SCENE = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("station")


@pytest.fixture(scope="module")
def cell(folder: Path) -> Iterator[StandInCell]:
    from tests.robot.real.conftest import WORKER

    cell = StandInCell(f"127.{WORKER}.99.1", folder)
    yield cell
    cells.disconnect()
    cell.close()


@pytest.fixture
def person(cell: StandInCell) -> Person:
    return Person(cell)


def configured(folder: Path, *overrides: str) -> Any:
    station = [f"robot.station={folder}/station.yaml", f"camera.folder={folder}/camera", "camera.frames=1"]
    return composed(["task=none", "transfer=none", "robot=ur5_real", "camera=files", *station, *overrides])


def built(folder: Path, operator: Operator | None, *overrides: str) -> RealRobot:
    cfg = configured(folder, *overrides)
    robot: RealRobot = instantiate(cfg.robot, _partial_=True)(
        workspace=instantiate(cfg.workspace),
        camera=instantiate(cfg.camera),
        objects=instantiate(cfg.objects, _convert_="all"),
        end_effector=instantiate(cfg.primitive.end_effector),
        operator=operator,
    )
    return robot


@pytest.fixture
def robot(cell: StandInCell, folder: Path, person: Person) -> RealRobot:
    robot = built(folder, person)
    robot.reset(SCENE, "seen")
    return robot


@pytest.fixture(scope="module")
def twin(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    """The simulated robot in the same scene."""
    twin = make_robot("robot.motion=full")
    twin.reset(SCENE, "seen")
    return twin


def best(robot: RealRobot, tried: Sequence[Pick] = ()) -> Pick:
    """On a flat place above the floor, two centimetres from those that were tried."""
    heightmap = robot.observe().heightmap
    rough = [np.abs(heightmap.height - np.roll(heightmap.height, shift, axis)) for axis in (0, 1) for shift in (-4, 4)]
    score = np.max(rough, axis=0) + (heightmap.height < 0.02) + ~heightmap.valid
    for pick in tried:
        score[max(0, pick.row - 8) : pick.row + 9, max(0, pick.col - 8) : pick.col + 9] = np.inf
    row, col = np.unravel_index(np.argmin(score), score.shape)
    return robot.workspace.pick(heightmap, int(row), int(col), 0.0)


def at_home(robot: RealRobot) -> bool:
    time.sleep(0.1)  # until the last message of the motion has come
    home = robot.station.robot.home
    assert home is not None
    return bool(np.abs(np.subtract(robot._cell.arm.joints, home)).max() < 1e-3)


def test_it_sees_what_the_simulated_robot_sees(robot: RealRobot, twin: SimulatedRobot) -> None:
    ours, theirs = robot.observe().heightmap, twin.truth().heightmap
    both = ours.valid & theirs.valid
    assert both.mean() > 0.5
    assert np.median(np.abs(ours.height - theirs.height)[both]) < 0.002
    assert (theirs.height > 0.02).mean() == pytest.approx((ours.height > 0.02).mean(), abs=0.02)


def test_the_background_is_the_empty_bin(robot: RealRobot) -> None:
    assert np.abs(robot.background().height[20:-20, 20:-20]).max() < 1e-3


def test_a_good_pick_succeeds_and_takes_the_object_out(robot: RealRobot) -> None:
    before, tried = (robot.observe().heightmap.height > 0.02).sum(), list[Pick]()
    for _ in range(4):  # with the sensor's noise a place may look flat that is not
        tried.append(best(robot, tried))
        outcome = robot.execute(tried[-1])
        if outcome.success:
            break
    assert (outcome.success, outcome.cause, outcome.truth) == (True, "ok", None)
    assert outcome.reading > 20
    assert (robot.observe().heightmap.height > 0.02).sum() < before - 50
    assert not robot.bin_empty()


def test_a_pick_of_the_floor_fails_and_the_arm_goes_home(robot: RealRobot) -> None:
    floor = robot.workspace.pick(robot.observe().heightmap, 10, 130, 0.0)
    outcome = robot.execute(floor)
    assert not outcome.success
    assert outcome.cause in ("no_seal", "slipped"), "a cup may seal on the floor, which does not come along"
    assert at_home(robot)


def test_a_protective_stop_aborts_the_attempt_and_waits_for_a_person(
    robot: RealRobot, person: Person, cell: StandInCell
) -> None:
    pick = best(robot)
    moves = cell.moves()

    def stop_in_the_middle() -> None:
        while cell.moves() < moves + 3:  # to above the bin, above the pick, down
            time.sleep(0.02)
        cell.protective_stop()

    thread = threading.Thread(target=stop_in_the_middle)
    thread.start()
    outcome = robot.execute(pick)
    thread.join()
    assert (outcome.success, outcome.cause, outcome.aborted) == (False, "protective_stop", True)
    assert "free it, and unlock it at the pendant" in person.asked[-1]
    assert at_home(robot)


def test_an_arm_that_is_not_at_home_moves_only_if_a_person_agrees(robot: RealRobot, person: Person, cell: StandInCell) -> None:
    robot._routes.to_gate()
    robot._routes.down(0.05, 0.05, 0.2, 0.0)
    robot._seen = None
    person.agree = False
    moves = cell.moves()
    with pytest.raises(RobotError, match="bring it there by hand"):
        robot.observe()
    assert cell.moves() == moves
    person.agree = True
    robot.observe()
    assert cell.moves() > moves


def test_a_dry_run_stops_above_the_pick(cell: StandInCell, folder: Path, person: Person) -> None:
    robot = built(folder, person, "robot.dry_run=true")
    robot.reset(SCENE, "seen")
    before = robot.observe().heightmap.height
    outcome = robot.execute(best(robot))
    assert (outcome.success, outcome.cause, outcome.aborted) == (False, "dry_run", True)
    assert np.median(np.abs(robot.observe().heightmap.height - before)) < 0.002


def test_a_gripper_picks_as_its_twin_does(
    tmp_path_factory: pytest.TempPathFactory, make_robot: Callable[..., SimulatedRobot]
) -> None:
    """The oracle's grasps, at angles all around: a wrong sign or a wrong height would miss them."""
    from tests.robot.real.conftest import WORKER

    folder = tmp_path_factory.mktemp("gripper")
    cell = StandInCell(f"127.{WORKER}.97.1", folder, ["primitive=grasp"])
    try:
        robot = built(folder, Person(cell), "primitive=grasp")
        twin = make_robot("primitive=grasp", "robot.motion=full")
        robot.reset(SCENE, "seen")
        twin.reset(SCENE, "seen")
        for _ in range(3):
            truth = twin.truth().heightmap
            logits = oracle(twin, angles=16)(truth.color, truth.height)
            angle, row, col = (int(i) for i in np.unravel_index(np.argmax(logits), logits.shape))
            theirs = twin.execute(twin.workspace.pick(truth, row, col, angle * np.pi / 16))
            ours = robot.execute(robot.workspace.pick(robot.observe().heightmap, row, col, angle * np.pi / 16))
            assert (ours.success, theirs.success) == (True, True)
            assert ours.reading == pytest.approx(theirs.reading, abs=0.002), "metres between the fingertips"
        assert at_home(robot)
    finally:
        cells.disconnect()
        cell.close()


def test_a_second_program_is_kept_out(robot: RealRobot, folder: Path) -> None:
    from filelock import FileLock, Timeout

    assert robot._cell is not None
    with pytest.raises(Timeout):
        FileLock(f"{(folder / 'station.yaml').absolute()}.lock", is_singleton=False).acquire(timeout=0)


@pytest.mark.parametrize(
    ("changes", "overrides", "message"),
    [
        ({"bin": None}, [], "real.py teach"),
        ({"calibration": None}, [], "real.py calibrate"),
        ({"background": None}, [], "real.py background"),
        ({}, ["primitive=grasp"], "use primitive=suction"),
        ({}, ["camera=side"], "add camera=realsense or camera=files"),
        ({}, ["workspace=grasp_rg2_real"], "choose a smaller one"),
    ],
)
def test_what_a_station_lacks_is_said_before_anything_connects(
    cell: StandInCell, folder: Path, tmp_path: Path, changes: dict, overrides: list[str], message: str
) -> None:
    station = stations.load(folder / "station.yaml")
    stations.save(station.model_copy(update=changes), tmp_path / "station.yaml")
    overrides = [*overrides, f"robot.station={tmp_path}/station.yaml"]
    if "camera=side" in overrides:
        cfg = composed(["robot=ur5_real", *overrides])
        with pytest.raises(Exception, match=message):
            instantiate(cfg.robot, _partial_=True)(
                workspace=instantiate(cfg.workspace),
                camera=instantiate(cfg.camera, _convert_="all"),
                objects=instantiate(cfg.objects, _convert_="all"),
                end_effector=instantiate(cfg.primitive.end_effector),
            )
        return
    with pytest.raises(Exception, match=message):
        built(folder, None, *overrides)


def test_nothing_can_be_learned_from_a_dry_run(cell: StandInCell, folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"leave it to demo\.py"):
        check_run(configured(folder, "robot.dry_run=true"))
