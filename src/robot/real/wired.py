"""The two tools on the controller's inputs and outputs: an older RG2, and a cup at an ejector or pump."""

from __future__ import annotations

import math
import time

from see2act.robot.real import station
from see2act.robot.real.tools import RELEASE_SECONDS, Gripper, Signals, Tool, ToolError, wait_for

LINKAGE = (0.038, 1.484)
"""Radians by which the bars that carry an RG2's fingertips are turned with these closed, and wide open. OnRobot's script for
Universal Robots has 110 sin(a) - 4.2 mm between the tips, and ends at 85 degrees."""
AT_REST = (0.1, 0.002)
"""Fingers are at rest if they move by less than so many metres (the second) in so many seconds: above the input's noise."""
BLOW_SECONDS = 0.3
"""How long an object is blown off."""


class DigitalGripper(Gripper):
    """An older RG2 at the tool's connector: a digital output closes it, and its width is a voltage.

    The voltage goes with the angle of the bars that carry the fingertips, and the opening with the sine of that. A straight
    line between closed and open would be wrong by 2 cm half-way.
    """

    if_open = "set tool.volts to what `python real.py check` shows with the fingers closed, and open"

    def __init__(self, section: station.Rg2DigitalOutput, signals: Signals):
        super().__init__(section)
        if section.volts[0] == section.volts[1]:
            raise ToolError("tool.volts must be two different voltages: with the fingertips closed, and open")
        self._section, self._signals = section, signals
        self.name = f"the RG2 at tool output {section.output}"

    def connect(self) -> None:
        self.reading()

    def close(self) -> None:
        pass

    def check(self) -> list[str]:
        volts = self._signals.tool_analog(0)
        return [f"{self.name}: {volts:.2f} V, which is an opening of {1000 * self._at(volts):.1f} mm"]

    def move(self, closed: bool) -> None:
        self._signals.set_tool_digital(self._section.output, closed)
        time.sleep(self._section.seconds)
        before = self.reading()
        time.sleep(AT_REST[0])
        if abs(self.reading() - before) > AT_REST[1]:
            raise ToolError(f"{self.name} still moves after {self._section.seconds} s: raise tool.seconds")

    def reading(self) -> float:
        return self._at(self._signals.tool_analog(0))

    def _at(self, volts: float) -> float:
        """Metres between the fingertips."""
        (closed, opened), (first, last) = self._section.volts, LINKAGE
        share = (volts - closed) / (opened - closed)
        angle = min(first + share * (last - first), math.pi / 2)
        return self._opening * (math.sin(angle) - math.sin(first)) / (math.sin(last) - math.sin(first))


class Ejector(Tool):
    """A cup at an ejector or pump on a digital output, with a pressure sensor or a vacuum switch.

    With a switch the threshold is the one that is set at the switch, and a reading is 1 or 0.
    """

    def __init__(self, section: station.VacuumOutput, signals: Signals):
        if (section.analog is None) == (section.digital is None):
            raise ToolError(
                "a vacuum_io tool needs tool.analog, for a pressure sensor, or tool.digital, for a switch; not both"
            )
        if section.blow_off == section.output:
            raise ToolError(f"tool.output and tool.blow_off are both {section.output}: they are two outputs")
        if section.volts[0] == section.volts[1]:
            raise ToolError("tool.volts must be two different voltages: at ambient pressure, and at tool.full_scale")
        if section.threshold >= section.full_scale:
            raise ToolError(
                f"tool.threshold is {section.threshold} kPa: it must be below tool.full_scale, {section.full_scale}"
            )
        self._section, self._signals = section, signals
        self.name = f"the vacuum at output {section.output}"
        self.unit = "switch" if section.analog is None else "kPa"
        self._threshold, self._full = (0.5, 1.0) if section.analog is None else (section.threshold, section.full_scale)
        self._free = 0.0

    def connect(self) -> None:
        self._sense()

    def close(self) -> None:
        pass

    def check(self) -> list[str]:
        if self._section.analog is None:
            return [f"{self.name}: the switch at input {self._section.digital} is {'on' if self._sense() else 'off'}"]
        volts = self._signals.analog(self._section.analog)
        return [f"{self.name}: {volts:.2f} V, which is {self._sense():.1f} kPa below ambient"]

    def prepare(self) -> None:
        if self._section.blow_off is not None:
            self._signals.set_digital(self._section.blow_off, False)
        self._signals.set_digital(self._section.output, True)
        time.sleep(self._section.seconds)
        self._free = self._sense()
        # A cup that is not free would make every later pick a failure, silently.
        if self._free + self._threshold > self._full:
            raise ToolError(f"{self.name} has vacuum before the pick: look for an object at the cup, dirt, and the set point")

    def engage(self) -> None:
        time.sleep(self._section.seconds)

    def reading(self) -> float:
        return self._sense() - self._free

    def holds(self, reading: float) -> bool:
        return reading > self._threshold

    def release(self) -> None:
        self._signals.set_digital(self._section.output, False)
        if self._section.blow_off is not None:
            try:
                self._signals.set_digital(self._section.blow_off, True)
                time.sleep(BLOW_SECONDS)
            finally:
                self._signals.set_digital(self._section.blow_off, False)
        wait_for(
            lambda: self._sense() < self._threshold,
            RELEASE_SECONDS,
            f"{self.name} is still there {RELEASE_SECONDS:g} s after the pump stopped: look for an object at the cup, and at "
            "the valve; a cup that seals well needs a blow-off (tool.blow_off)",
        )

    def _sense(self) -> float:
        """Kilopascals below ambient; 1 or 0 of a switch."""
        if self._section.analog is None:
            assert self._section.digital is not None
            return float(self._signals.digital(self._section.digital))
        volts, (ambient, full) = self._signals.analog(self._section.analog), self._section.volts
        share = (volts - ambient) / (full - ambient)
        if not -0.1 <= share <= 1.1:
            raise ToolError(
                f"{self.name} has a sensor that gives {volts:.2f} V, not {ambient:g} to {full:g} V: look at the sensor's cable "
                f"and power at analog input {self._section.analog}, and at tool.volts"
            )
        return share * self._section.full_scale
