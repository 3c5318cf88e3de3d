"""The real client ur_rtde against a stand-in for the controller, in a process of its own."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stand_in.process import ControllerProcess
from see2act.robot.real.box import Box
from see2act.robot.real.controller import ArmError, LinkLost, ProtectiveStop
from see2act.robot.real.station import CalibrationSection, Rg2Modbus, Station, TouchSection
from see2act.robot.real.ur import UrArm

Later = Callable[..., None]
SLOW_ENOUGH = 0.1
"""m/s at which a descent of 10 cm takes the stand-in half a second, before a touch test."""


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Python's own answer to Ctrl-C, which the processes of parallel tests ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def below(arm: UrArm, metres: float) -> np.ndarray:
    target = arm.tip.copy()
    target[2, 3] -= metres
    return target


def tip_at_rest(arm: UrArm) -> np.ndarray:
    time.sleep(0.1)  # until the last message of the motion has come
    return arm.tip


def test_a_straight_move_ends_at_its_target(arm: UrArm, station: Station) -> None:
    start, target = arm.tip, below(arm, 0.1)
    assert arm.move_line(target, 0.25, Box.above(station)) is None
    assert np.allclose(tip_at_rest(arm), target, atol=1e-4)
    assert not np.allclose(arm.tip, start, atol=0.05)


def test_taught_joints_are_reached(arm: UrArm, station: Station) -> None:
    assert station.robot.drop is not None
    arm.move_joints(station.robot.drop, 1.0)
    assert arm.joints == pytest.approx(station.robot.drop, abs=1e-3)


def test_the_tip_is_that_of_the_station(arm: UrArm, controller: ControllerProcess) -> None:
    assert controller.get("tcp")[2] == pytest.approx(0.14)


def test_fingers_may_be_turned_about_the_flange(controller: ControllerProcess, station: Station) -> None:
    fingers = Rg2Modbus(host="127.0.0.1", tip=0.2, mass=0.8, depth=0.05, turn=0.5)
    arm = UrArm(station.model_copy(update={"tool": fingers}))
    arm.connect()
    assert controller.get("tcp") == pytest.approx([0, 0, 0.2, 0, 0, 0.5])
    arm.close()


def test_a_force_stops_the_descent_where_it_is(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later
) -> None:
    target = below(arm, 0.1)
    when(0.2, controller.set, force=[0.0, 0.0, 25.0, 0.0, 0.0, 0.0])
    force = arm.move_line(target, SLOW_ENOUGH, Box.above(station), force_limit=20)
    assert force == pytest.approx(25)
    assert arm.tip[2, 3] > target[2, 3] + 0.01
    assert not controller.call("moving")


def test_a_force_that_was_there_before_does_not_count(arm: UrArm, station: Station, controller: ControllerProcess) -> None:
    controller.set(force=[0.0, 0.0, 25.0, 0.0, 0.0, 0.0])
    time.sleep(0.05)
    assert arm.move_line(below(arm, 0.02), 0.25, Box.above(station), force_limit=20) is None


def test_a_protective_stop_is_said_and_not_cleared(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later
) -> None:
    when(0.2, controller.call, "protective_stop")
    with pytest.raises(ProtectiveStop, match=r"free it, and unlock it at the pendant"):
        arm.move_line(below(arm, 0.1), SLOW_ENOUGH, Box.above(station))
    with pytest.raises(ProtectiveStop):  # and stays
        arm.move_line(below(arm, 0.01), SLOW_ENOUGH, Box.above(station))
    assert "dashboard: unlock protective stop" not in controller.log()


def test_after_a_person_has_unlocked_it_the_arm_moves_again(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later
) -> None:
    when(0.2, controller.call, "protective_stop")
    with pytest.raises(ProtectiveStop):
        arm.move_line(below(arm, 0.1), SLOW_ENOUGH, Box.above(station))
    controller.set(safety_mode=1)
    time.sleep(0.05)
    target = below(arm, -0.02)
    arm.move_line(target, 0.25, Box.above(station))
    assert np.allclose(tip_at_rest(arm), target, atol=1e-4)


def test_a_target_out_of_reach_is_refused_before_anything_moves(
    arm: UrArm, station: Station, controller: ControllerProcess
) -> None:
    far = replace(Box.above(station), low=np.full(3, -9.0), high=np.full(3, 9.0))
    moves = [entry for entry in controller.log() if entry == "command 3"]
    with pytest.raises(ArmError, match="cannot reach"):
        arm.move_line(below(arm, -2.0), 0.25, far)
    assert [entry for entry in controller.log() if entry == "command 3"] == moves
    assert controller.get("program"), "the control script must outlive the question"


@pytest.mark.parametrize(("step", "side"), [((0.5, 0, 0), "near"), ((0, 0.5, 0), "right"), ((0, 0, -0.3), "floor")])
def test_a_target_outside_the_taught_bin_is_refused(arm: UrArm, station: Station, step: tuple, side: str) -> None:
    target = arm.tip.copy()
    target[:3, 3] += step
    with pytest.raises(ArmError, match=rf"the target is \d+ mm beyond the {side}"):
        arm.move_line(target, 0.25, Box.above(station))


@pytest.mark.parametrize("how", ["cut", "close"])
def test_a_lost_link_ends_the_move_and_hangs_nothing(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later, how: str
) -> None:
    when(0.2, controller.call, how)
    start = time.monotonic()
    with pytest.raises(LinkLost, match="see to its cable"):
        arm.move_line(below(arm, 0.1), SLOW_ENOUGH, Box.above(station))
    arm.close()
    assert time.monotonic() - start < 8


def test_a_program_that_was_stopped_at_the_pendant_ends_the_move(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later
) -> None:
    when(0.2, controller.call, "kill_script")
    with pytest.raises(ArmError, match="ended at the pendant"):
        arm.move_line(below(arm, 0.1), SLOW_ENOUGH, Box.above(station))
    target = below(arm, 0.01)  # and the next one starts it again
    arm.move_line(target, 0.25, Box.above(station))
    assert np.allclose(tip_at_rest(arm), target, atol=1e-4)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"robot_mode": 5}, "release its brakes"),
        ({"safety_mode": 3}, "protective stop"),
        ({"safety_mode": 7}, "robot emergency stop"),
        ({"slider": 0.0}, "speed slider"),
        ({"version": (5, 11, 0), "remote": False}, "local mode"),
    ],
)
def test_an_arm_that_must_not_move_is_refused_with_the_mend(
    controller: ControllerProcess, station: Station, state: dict, message: str
) -> None:
    controller.set(**state)
    arm = UrArm(station)
    with pytest.raises(ArmError, match=message):
        arm.connect()
    arm.close()
    assert not any(entry.startswith(("script", "command")) for entry in controller.log())


def test_remote_control_of_a_newer_polyscope_is_enough(controller: ControllerProcess, station: Station) -> None:
    controller.set(version=(5, 11, 0), remote=True)
    arm = UrArm(station)
    arm.connect()
    assert arm.status().remote
    assert controller.get("program")
    arm.close()


def test_no_controller_at_the_address_is_said_at_once(address: str, station: Station) -> None:
    start = time.monotonic()
    with pytest.raises(ArmError, match=f"no controller answers at {address}"):
        UrArm(station).connect()
    assert time.monotonic() - start < 3


def test_a_move_that_never_begins_is_stopped(
    arm: UrArm, station: Station, controller: ControllerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("see2act.robot.real.ur.SPARE_TIME", 0.3)
    controller.set(refuse_moves=True)
    with pytest.raises(ArmError, match="did not end in time"):
        arm.move_line(below(arm, 0.01), 0.25, Box.above(station))
    assert not controller.call("moving")


def test_an_arm_that_ends_elsewhere_is_noticed(arm: UrArm, station: Station, controller: ControllerProcess) -> None:
    controller.set(off_by=0.005)
    with pytest.raises(ArmError, match="5 mm and 0 degrees from"):
        arm.move_line(below(arm, 0.05), 0.25, Box.above(station))


def test_ctrl_c_stops_the_arm_at_once(
    arm: UrArm, station: Station, controller: ControllerProcess, when: Later, ctrl_c: None
) -> None:
    target = below(arm, 0.1)
    when(0.2, os.kill, os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        arm.move_line(target, SLOW_ENOUGH, Box.above(station))
    assert not controller.call("moving")
    height = tip_at_rest(arm)[2, 3]
    assert height > target[2, 3] + 0.01
    time.sleep(0.2)
    assert arm.tip[2, 3] == pytest.approx(height, abs=1e-5)


def test_the_arm_is_slow_until_a_touch_test_was_clean(controller: ControllerProcess, station: Station) -> None:
    seen = CalibrationSection(
        serial="7", size=(1280, 720), camera=tuple(map(tuple, np.eye(4))), error=5e-4, views=25, date="2026-01-01"
    )
    touched = TouchSection(offset=0.001, serial="7", date="2026-01-01")
    speeds = []
    for each in (station, station.model_copy(update={"calibration": seen, "touch": touched})):
        arm = UrArm(each)
        arm.connect()
        arm.move_line(below(arm, 0.02), 0.2, Box.above(each))
        speeds.append(controller.get("speed"))
        arm.close()
    assert speeds == pytest.approx([0.05, 0.2])


def test_inputs_and_outputs(arm: UrArm, controller: ControllerProcess) -> None:
    controller.set(analog=[2.5, 0.5], tool_analog=[1.25, 3.5], inputs=0b100)
    arm.set_digital(3, True)
    arm.set_tool_digital(1, True)
    time.sleep(0.1)
    assert controller.get("outputs") == 1 << 3 | 1 << 17
    assert (arm.analog(0), arm.analog(1)) == (2.5, 0.5)
    assert (arm.tool_analog(0), arm.tool_analog(1)) == (1.25, 3.5)
    assert [arm.digital(i) for i in range(4)] == [False, False, True, False]
    arm.set_digital(3, False)
    time.sleep(0.1)
    assert controller.get("outputs") == 1 << 17


def test_a_missing_package_is_named(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rtde_receive", None)
    with pytest.raises(ArmError, match=r"pip install 'see2act\[real\]'"):
        UrArm(station).connect()
