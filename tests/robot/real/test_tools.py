"""The tools of a station, against registers and signals that behave as the devices do."""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from benchmarks.stand_in import modbus as stand_in
from benchmarks.stand_in.modbus import ComputeBox
from see2act.robot.real import modbus, onrobot, station, tools, wired
from see2act.robot.real.tools import Tool, ToolError

COMMON: dict[str, Any] = {"tip": 0.2, "mass": 1.0, "depth": 0.02}
HOST = "127.0.0.73"


@dataclass
class Signals:
    """Inputs that tests set, and the outputs that were switched."""

    outputs: dict[int, bool] = field(default_factory=dict)
    tool_outputs: dict[int, bool] = field(default_factory=dict)
    log: list[tuple[int, bool]] = field(default_factory=list)
    digital_of: Callable[[int], bool] = lambda channel: False
    analog_of: Callable[[int], float] = lambda channel: 0.0
    tool_analog_of: Callable[[int], float] = lambda channel: 0.0

    def set_digital(self, channel: int, on: bool) -> None:
        self.outputs[channel] = on
        self.log.append((channel, on))

    def set_tool_digital(self, channel: int, on: bool) -> None:
        self.tool_outputs[channel] = on

    def digital(self, channel: int) -> bool:
        return self.digital_of(channel)

    def analog(self, channel: int) -> float:
        return self.analog_of(channel)

    def tool_analog(self, channel: int) -> float:
        return self.tool_analog_of(channel)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less for what will not come."""
    monkeypatch.setattr(modbus, "TIMEOUT", 0.3)
    monkeypatch.setattr(onrobot, "START_SECONDS", 0.1)
    monkeypatch.setattr(onrobot, "MOVE_SECONDS", 1.0)
    for module in (onrobot, wired):
        monkeypatch.setattr(module, "RELEASE_SECONDS", 0.3)
    monkeypatch.setattr(wired, "BLOW_SECONDS", 0.03)
    monkeypatch.setattr(wired, "AT_REST", (0.03, 0.002))


@pytest.fixture
def fingers() -> stand_in.Rg2:
    return stand_in.Rg2(speed=1.0)


@pytest.fixture
def cups() -> stand_in.Vg10:
    return stand_in.Vg10(seconds=0.02)


@pytest.fixture
def serve() -> Iterator[Callable[..., ComputeBox]]:
    """Starts Compute Boxes and stops them at the end."""
    boxes = []

    def start(tool: stand_in.Registers, unit: int = 65) -> ComputeBox:
        boxes.append(ComputeBox(tool, HOST, unit=unit))
        return boxes[-1]

    yield start
    for box in boxes:
        box.close()


def _rg2(box: ComputeBox, **values: Any) -> Tool:
    values = {"opening": 0.105, **values}
    section = station.Rg2Modbus(host=box.host, port=box.port, **COMMON, **values)
    tool = tools.build(section, Signals())
    tool.connect()
    return tool


def _vg10(box: ComputeBox, **values: Any) -> Tool:
    section = station.Vg10(host=box.host, port=box.port, seconds=0.15, **COMMON, **values)
    tool = tools.build(section, Signals())
    tool.connect()
    return tool


def _vacuum(signals: Signals, **values: Any) -> Tool:
    return tools.build(station.VacuumOutput(seconds=0.01, **COMMON, **values), signals)


def _wired_rg2(signals: Signals, **values: Any) -> Tool:
    values = {"opening": 0.105, "volts": (0.264, 3.0), **values}
    return tools.build(station.Rg2DigitalOutput(seconds=0.02, **COMMON, **values), signals)


def _attempt(tool: Tool) -> tuple[float, bool]:
    tool.prepare()
    tool.engage()
    reading = tool.reading()
    return reading, tool.holds(reading)


# RG2 at a Compute Box


def test_rg2_holds_an_object_and_lets_it_go(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.between = lambda: 0.032
    tool = _rg2(serve(fingers), force=25.0)
    assert tool.half_opening == pytest.approx(0.0525)
    assert _attempt(tool) == (pytest.approx(0.032, abs=1e-4), True)
    assert fingers.force == 25.0
    tool.release()
    assert fingers.opening == pytest.approx(0.105)
    assert tool.reading() == pytest.approx(0.105)
    assert tool.unit == "m"


@pytest.mark.parametrize("width", [0.0, 0.006])
def test_rg2_does_not_hold_nothing_or_what_is_too_thin(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, width: float
) -> None:
    fingers.between = lambda: width
    reading, held = _attempt(_rg2(serve(fingers)))
    assert reading == pytest.approx(width, abs=1e-4)
    assert not held


def test_fingers_are_closed_to_one_tip(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    box = serve(fingers)
    section = station.Rg2Modbus(host=box.host, port=box.port, **COMMON)
    tools.point(section, Signals())
    assert fingers.opening == 0
    commands = fingers.commands
    tools.point(section, Signals())
    assert fingers.commands == commands, "they are closed already"


def test_fingers_around_something_have_no_tip(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.between = lambda: 0.02
    box = serve(fingers)
    with pytest.raises(ToolError, match="take away what is between them"):
        tools.point(station.Rg2Modbus(host=box.host, port=box.port, **COMMON), Signals())


def test_rg2_notices_that_an_object_was_lost(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.between = lambda: 0.05
    tool = _rg2(serve(fingers))
    assert _attempt(tool)[1]
    fingers.between = lambda: 0.0
    time.sleep(0.2)
    assert not tool.holds(tool.reading())


def test_rg2_wide_open_without_a_grip_holds_nothing(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fingers that were stopped half-way are above the threshold, and press on nothing."""
    tool = _rg2(serve(fingers))
    fingers.between = lambda: 0.05
    assert _attempt(tool)[1]
    monkeypatch.setattr(fingers, "_gripped", lambda: False)
    reading = tool.reading()
    assert reading == pytest.approx(0.05, abs=1e-4)
    assert not tool.holds(reading)


def test_rg2_reads_fingertips_pressed_below_zero(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    tool = _rg2(serve(fingers))
    fingers._opening = fingers._target = -0.0008
    assert tool.reading() == pytest.approx(-0.0008)


@pytest.mark.parametrize("delay", [0.0, 0.15])
def test_rg2_returns_when_the_fingers_are_at_rest(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, delay: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the busy bit comes late."""
    monkeypatch.setattr(onrobot, "START_SECONDS", 0.3)
    fingers.delay, fingers.speed = delay, 0.5
    tool = _rg2(serve(fingers))
    tool.prepare()
    tool.engage()
    assert fingers.opening == 0.0


def test_rg2_waits_for_a_move_in_progress_because_commands_are_ignored_then(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2
) -> None:
    tool = _rg2(serve(fingers))
    fingers.speed = 0.2
    fingers.write({0: 200, 1: 0, 2: 16})  # another program closes it
    time.sleep(0.06)
    commands = fingers.commands
    fingers.write({0: 200, 1: 1050, 2: 16})
    assert fingers.commands == commands
    tool.prepare()
    assert fingers.opening == pytest.approx(0.105)


def test_rg2_that_stays_busy_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    tool = _rg2(serve(fingers))
    tool.prepare()
    fingers.speed = 1e-6
    start = time.monotonic()
    with pytest.raises(ToolError, match=rf"RG2 at {HOST}:\d+, unit 65 is still busy.*blocks its fingers"):
        tool.engage()
    assert time.monotonic() - start < 2


def test_rg2_that_does_not_open_far_enough_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.widest = 0.09
    tool = _rg2(serve(fingers))
    tool.engage()
    with pytest.raises(ToolError, match=r"opened to 90\.0 mm, not to the 105\.0 mm of tool\.opening.*set tool\.opening"):
        tool.prepare()


def test_rg2_that_does_not_close_is_an_error(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = _rg2(serve(fingers))
    tool.prepare()
    monkeypatch.setattr(fingers, "write", lambda values: None)
    with pytest.raises(ToolError, match="did not close"):
        tool.engage()


def test_rg2_that_grips_an_object_as_wide_as_its_opening_did_close(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2
) -> None:
    fingers.between = lambda: 0.103
    assert _attempt(_rg2(serve(fingers))) == (pytest.approx(0.103), True)


@pytest.mark.parametrize("bit", [2, 3, 4, 5, 6])
def test_rg2_with_a_safety_bit_is_an_error_and_is_not_moved(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, bit: int
) -> None:
    tool = _rg2(serve(fingers))
    tool.prepare()
    fingers.safety, commands = 1 << bit, fingers.commands
    for method in (tool.check, tool.prepare, tool.engage, tool.reading, tool.release):
        with pytest.raises(ToolError, match=r"stopped for safety \(.*have a person switch its power off and on"):
            method()
    assert fingers.commands == commands
    assert fingers.safety == 1 << bit


def test_rg2_whose_safety_trips_during_a_move_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.speed = 0.15
    tool = _rg2(serve(fingers))
    tool.prepare()
    trip = threading.Timer(0.2, lambda: setattr(fingers, "safety", 1 << 3))
    trip.start()
    with pytest.raises(ToolError, match="safety circuit 1 has tripped"):
        tool.engage()
    trip.join()


def test_check_of_an_rg2_moves_nothing(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    lines = _rg2(serve(fingers)).check()
    assert "105.4 mm between the fingertips, which are 4.6 mm each" in lines[0]
    assert "no grip" in lines[1]
    assert fingers.commands == 0


# The connection


def test_nothing_at_the_address_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    box = serve(fingers)
    box.close()
    with pytest.raises(ToolError, match=rf"nothing listens where the RG2 at {HOST}:\d+.*tool\.host"):
        _rg2(box)


def test_wrong_unit_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    with pytest.raises(ToolError, match=r"unit 66 does not answer.*tool\.unit"):
        _rg2(serve(fingers), unit=66)


def test_wrong_tool_is_an_error(serve: Callable[..., ComputeBox], cups: stand_in.Vg10) -> None:
    with pytest.raises(ToolError, match=r"refuses a message .*another tool"):
        _rg2(serve(cups))


@pytest.mark.parametrize("how", ["cut", "silent", "closed"])
def test_lost_link_is_an_error_at_the_next_call_and_until_connect(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, how: str
) -> None:
    box = serve(fingers)
    tool = _rg2(box)
    tool.prepare()
    if how == "cut":
        box.cut()
    elif how == "silent":
        box.silent = True
    else:
        box.close()
    commands, start = fingers.commands, time.monotonic()
    with pytest.raises(ToolError, match=r"does not answer.*cables"):
        tool.engage()
    assert time.monotonic() - start < 2
    box.silent = False
    # No silent new connection: the arm may have moved meanwhile, and nobody knows what the fingers did.
    with pytest.raises(ToolError, match="not connected"):
        tool.engage()
    assert fingers.commands == commands
    if how != "closed":
        tool.connect()
        tool.engage()
        assert fingers.commands == commands + 1


def test_second_program_at_the_box_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    box = serve(fingers)
    first = _rg2(box)
    with pytest.raises(ToolError, match="whether another program is connected"):
        _rg2(box)
    first.reading()


def test_link_lost_during_a_move_is_an_error(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    fingers.speed = 0.15
    box = serve(fingers)
    tool = _rg2(box)
    tool.prepare()
    cut = threading.Timer(0.2, box.cut)
    cut.start()
    with pytest.raises(ToolError, match="does not answer"):
        tool.engage()
    cut.join()


def test_close_is_safe_twice_and_moves_nothing(serve: Callable[..., ComputeBox], fingers: stand_in.Rg2) -> None:
    tool = _rg2(serve(fingers))
    tool.close()
    tool.close()
    assert fingers.commands == 0
    tool.connect()
    tool.reading()


def test_errors_are_one_line_and_pymodbus_adds_none(
    serve: Callable[..., ComputeBox], fingers: stand_in.Rg2, caplog: pytest.LogCaptureFixture
) -> None:
    box = serve(fingers)
    box.close()
    with caplog.at_level(logging.INFO), pytest.raises(ToolError) as error:
        _rg2(box)
    assert "\n" not in str(error.value)
    assert not caplog.records


def test_missing_pymodbus_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    tool = tools.build(station.Rg2Modbus(host=HOST, **COMMON), Signals())
    monkeypatch.setitem(sys.modules, "pymodbus.client", None)
    with pytest.raises(ToolError, match=r"needs the package pymodbus: pip install 'see2act\[real\]'"):
        tool.connect()


# VG10


@pytest.mark.parametrize(("channel", "mine", "other"), [("a", "a", "b"), ("b", "b", "a")])
def test_vg10_uses_its_channel_only(
    serve: Callable[..., ComputeBox], cups: stand_in.Vg10, channel: str, mine: str, other: str
) -> None:
    tool = _vg10(serve(cups), channel=channel)
    tool.prepare()
    assert cups.gripping(mine)
    assert not cups.gripping(other)
    cups.sealed = lambda where: where == mine
    tool.engage()
    reading = tool.reading()
    assert reading == pytest.approx((0.40 - stand_in.FREE) * 101.3, abs=0.3)
    assert tool.holds(reading)
    cups.sealed = lambda where: where == other
    time.sleep(0.15)
    assert not tool.holds(tool.reading())


def test_vg10_without_seal_holds_nothing(serve: Callable[..., ComputeBox], cups: stand_in.Vg10) -> None:
    reading, held = _attempt(_vg10(serve(cups)))
    assert reading == pytest.approx(0, abs=0.3)
    assert not held


@pytest.mark.parametrize("sealed", ["a", "b"])
def test_vg10_with_both_channels_holds_by_either(serve: Callable[..., ComputeBox], cups: stand_in.Vg10, sealed: str) -> None:
    tool = _vg10(serve(cups))
    tool.prepare()
    cups.sealed = lambda where: where == sealed
    tool.engage()
    assert tool.holds(tool.reading())
    tool.release()
    assert not cups.gripping("a")
    assert not cups.gripping("b")


def test_vg10_with_an_object_before_the_pick_is_an_error(serve: Callable[..., ComputeBox], cups: stand_in.Vg10) -> None:
    cups.sealed = lambda where: where == "b"
    with pytest.raises(ToolError, match=r"before the pick.*object at the cups"):
        _vg10(serve(cups)).prepare()


def test_vg10_whose_vacuum_stays_is_an_error(serve: Callable[..., ComputeBox], cups: stand_in.Vg10) -> None:
    tool = _vg10(serve(cups))
    tool.prepare()
    cups.sealed = lambda where: True
    tool.engage()
    assert tool.holds(tool.reading())
    cups.seconds = 100.0
    with pytest.raises(ToolError, match="still has vacuum"):
        tool.release()


def test_check_of_a_vg10_switches_nothing(serve: Callable[..., ComputeBox], cups: stand_in.Vg10) -> None:
    tool = _vg10(serve(cups))
    assert [line.split(": ")[1] for line in tool.check()] == [
        "0.0 kPa below ambient in channel a",
        "0.0 kPa below ambient in channel b",
    ]
    assert not cups.gripping("a")
    assert not cups.gripping("b")


# A cup at an ejector


def _sensor(signals: Signals, sealed: Callable[[], bool]) -> None:
    """A pressure sensor of 1 to 5 V for 0 to 100 kPa, at analog input 1: 60 kPa sealed, 8 kPa free."""

    def volts(channel: int) -> float:
        assert channel == 1
        pressure = (60.0 if sealed() else 8.0) if signals.outputs.get(2) else 0.0
        return 1 + 4 * pressure / 100

    signals.analog_of = volts


def test_vacuum_by_a_sensor_counts_from_the_free_cup() -> None:
    signals, sealed = Signals(), [False]
    _sensor(signals, lambda: sealed[0])
    tool = _vacuum(signals, output=2, analog=1)
    assert tool.unit == "kPa"
    assert tool.half_opening == 0
    assert _attempt(tool) == (pytest.approx(0), False)
    tool.release()
    tool.prepare()
    sealed[0] = True
    tool.engage()
    assert tool.reading() == pytest.approx(52)
    assert tool.holds(tool.reading())
    tool.release()
    assert signals.outputs == {2: False}


def test_vacuum_by_a_switch_reads_on_or_off() -> None:
    signals, sealed = Signals(), [False]
    signals.digital_of = lambda channel: channel == 5 and sealed[0] and signals.outputs[2]
    tool = _vacuum(signals, output=2, digital=5)
    assert tool.unit == "switch"
    assert _attempt(tool) == (0.0, False)
    sealed[0] = True
    assert tool.reading() == 1.0
    assert tool.holds(1.0)
    tool.release()


def test_release_blows_off_and_ends_blowing() -> None:
    signals = Signals()
    _sensor(signals, lambda: False)
    tool = _vacuum(signals, output=2, analog=1, blow_off=3)
    tool.prepare()
    assert signals.outputs == {2: True, 3: False}
    signals.log.clear()
    tool.release()
    assert signals.log == [(2, False), (3, True), (3, False)]


def test_blowing_ends_when_it_is_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    signals = Signals()
    tool = _vacuum(signals, output=2, analog=1, blow_off=3)

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(wired.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        tool.release()
    assert signals.outputs[3] is False


@pytest.mark.parametrize("kind", ["sensor", "switch"])
def test_vacuum_with_an_object_before_the_pick_is_an_error(kind: str) -> None:
    signals = Signals(analog_of=lambda channel: 1 + 4 * 0.85, digital_of=lambda channel: True)
    tool = _vacuum(signals, analog=1) if kind == "sensor" else _vacuum(signals, digital=1)
    with pytest.raises(ToolError, match="vacuum at output 0 has vacuum before the pick"):
        tool.prepare()


def test_vacuum_that_stays_is_an_error() -> None:
    signals = Signals(analog_of=lambda channel: 1 + 4 * 0.6)
    with pytest.raises(ToolError, match=r"still there .*blow_off"):
        _vacuum(signals, analog=1).release()


def test_broken_cable_of_the_sensor_is_an_error() -> None:
    with pytest.raises(ToolError, match=r"0\.00 V, not 1 to 5 V.*analog input 1"):
        _vacuum(Signals(), analog=1).connect()


def test_check_of_a_vacuum_switches_nothing() -> None:
    signals = Signals(analog_of=lambda channel: 1.4)
    assert _vacuum(signals, analog=0).check() == ["the vacuum at output 0: 1.40 V, which is 10.0 kPa below ambient"]
    assert _vacuum(signals, digital=4).check() == ["the vacuum at output 0: the switch at input 4 is off"]
    assert not signals.log


# RG2 at the tool's connector


def _volts(opening: float) -> float:
    """OnRobot's script for Universal Robots, the other way round. Metres between the fingertips, volts."""
    angle = math.asin((1000 * opening + 9.2 - 5) / 110)
    return (angle + 0.087266462) / (math.pi / 2) * 2.9760034 + 0.026


def _with_fingers(signals: Signals, width: Callable[[], float]) -> None:
    def volts(channel: int) -> float:
        assert channel == 0
        return _volts(width() if signals.tool_outputs.get(0) else 0.105)

    signals.tool_analog_of = volts


@pytest.mark.parametrize(("width", "held"), [(0.0, False), (0.006, False), (0.02, True), (0.06, True), (0.09, True)])
def test_wired_rg2_reads_the_opening_as_onrobots_script_does(width: float, held: bool) -> None:
    signals = Signals()
    _with_fingers(signals, lambda: width)
    tool = _wired_rg2(signals)
    assert _attempt(tool) == (pytest.approx(width, abs=0.0005), held)
    assert signals.tool_outputs == {0: True}
    tool.release()
    assert signals.tool_outputs == {0: False}


def test_wired_rg2_that_does_not_move_is_an_error() -> None:
    signals = Signals(tool_analog_of=lambda channel: _volts(0.105))
    tool = _wired_rg2(signals)
    tool.prepare()
    with pytest.raises(ToolError, match=r"RG2 at tool output 0 did not close.*cable"):
        tool.engage()


@pytest.mark.parametrize("volts", [0.0, 1.5])
def test_wired_rg2_that_does_not_open_is_an_error(volts: float) -> None:
    with pytest.raises(ToolError, match=r"opened to .* not to the 105\.0 mm.*set tool\.volts"):
        _wired_rg2(Signals(tool_analog_of=lambda channel: volts)).prepare()


def test_wired_rg2_that_still_moves_is_an_error() -> None:
    start = time.monotonic()
    signals = Signals(tool_analog_of=lambda channel: min(3.0, 0.3 + 5 * (time.monotonic() - start)))
    with pytest.raises(ToolError, match=r"still moves after 0\.02 s: raise tool\.seconds"):
        _wired_rg2(signals).prepare()


def test_check_of_a_wired_rg2_gives_the_voltage_and_moves_nothing() -> None:
    signals = Signals(tool_analog_of=lambda channel: 3.0)
    assert _wired_rg2(signals).check() == ["the RG2 at tool output 0: 3.00 V, which is an opening of 105.0 mm"]
    assert not signals.tool_outputs


# Refusals


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (station.VacuumOutput(**COMMON), "tool.analog.* or tool.digital"),
        (station.VacuumOutput(analog=0, digital=0, **COMMON), "tool.analog.* or tool.digital"),
        (station.VacuumOutput(analog=0, blow_off=0, **COMMON), "two outputs"),
        (station.VacuumOutput(analog=0, volts=(1, 1), **COMMON), "tool.volts"),
        (station.VacuumOutput(analog=0, threshold=100, **COMMON), "tool.threshold"),
        (station.Rg2Modbus(host=HOST, force=41, **COMMON), "tool.force"),
        (station.Rg2Modbus(host=HOST, opening=0.12, **COMMON), "tool.opening"),
        (station.Rg2Modbus(host=HOST, opening=0.1, threshold=0.1, **COMMON), "tool.threshold"),
        (station.Rg2DigitalOutput(opening=0.05, threshold=0.06, **COMMON), "tool.threshold"),
        (station.Rg2DigitalOutput(volts=(1, 1), **COMMON), "tool.volts"),
        (station.Vg10(host=HOST, vacuum=15, **COMMON), "tool.vacuum is only 15.2 kPa"),
    ],
)
def test_numbers_that_cannot_be_are_refused(section: station.Tool, message: str) -> None:
    with pytest.raises(ToolError, match=message):
        tools.build(section, Signals())


@pytest.mark.parametrize(
    "section",
    [
        station.Rg2Modbus(host="192.0.2.1", **COMMON),
        station.Vg10(host="192.0.2.1", **COMMON),
        station.Rg2DigitalOutput(**COMMON),
        station.VacuumOutput(analog=0, **COMMON),
    ],
)
def test_building_touches_nothing(section: station.Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise AssertionError("touched the device")

    monkeypatch.setattr("socket.create_connection", fail)
    for name in ("set_digital", "set_tool_digital", "digital", "analog", "tool_analog"):
        monkeypatch.setattr(Signals, name, fail)
    tool = tools.build(section, Signals())
    tool.close()
