"""OnRobot's RG2 and VG10 at a Compute Box, by Modbus TCP.

Registers are those of OnRobot's "Connectivity guide".
"""

from __future__ import annotations

import time
from typing import NamedTuple

from see2act.robot.real import station
from see2act.robot.real.modbus import Link
from see2act.robot.real.tools import RELEASE_SECONDS, Gripper, Tool, ToolError, wait_for

STRONGEST = 40.0
"""Newtons of an RG2, at most; from its data sheet."""
START_SECONDS = 0.3
"""Until a gripper that has something to do says that it is busy."""
MOVE_SECONDS = 5.0
"""The longest that a move may take. The whole way takes one to three, by the force."""
ATMOSPHERE = 101.3
"""Kilopascals that a VG10 calls 100 percent vacuum."""

_COMMAND = 0
"""First register to write. RG2: force (0.1 N), width (0.1 mm), control. VG10: control of channel A, and of B."""
_GRIP_WITH_OFFSET = 16
"""Control of an RG2: go, and count the width between the fingertips, not between the aluminium fingers."""
_STATE, _STATE_COUNT = 258, 18
"""Registers of an RG2's state. Of these are used: 0 the fingertip offset (0.1 mm), 10 the status, 17 the width between the
fingertips (0.1 mm). Lengths are signed: pressed rubber makes a width less than zero."""
_BUSY, _GRIPPED = 1 << 0, 1 << 1
_SAFETY = {
    2: "safety switch 1 is pressed",
    3: "safety circuit 1 has tripped",
    4: "safety switch 2 is pressed",
    5: "safety circuit 2 has tripped",
    6: "a safety switch was pressed at power-on",
}
"""Bits of an RG2's status."""
_LEVELS = 258
"""First register of a VG10's vacuum, 0.1 percent, of channels A and B."""
_GRIP, _RELEASE = 0x0100, 0x0000
"""Control of a VG10: build up the vacuum of the low byte (percent), or let air in and stop the pump."""


class Rg2(Gripper):
    """An RG2.

    An object counts as held if the opening is above the threshold *and* the gripper reports a grip. Each alone is wrong at
    times: fingertips that press on each other are reported as a grip too, and fingers that stand open without a grip press on
    nothing. For objects thinner than the threshold, lower it.
    """

    if_open = "set tool.opening to what was reached: the fingertips take some of the 110 mm"

    def __init__(self, section: station.Rg2Modbus):
        super().__init__(section)
        if section.force > STRONGEST:
            raise ToolError(f"tool.force is {section.force} N, and an RG2 has {STRONGEST} N: lower it")
        self._link = Link("RG2", section)
        self.name = self._link.name
        self._force = section.force
        self._gripped = False

    def connect(self) -> None:
        self._link.connect()
        self._look()

    def close(self) -> None:
        self._link.close()

    def check(self) -> list[str]:
        state = self._look()
        return [
            f"{self.name}: {1000 * state.opening:.1f} mm between the fingertips, which are {1000 * state.offset:.1f} mm each",
            f"{self.name}: {'a grip is' if state.gripped else 'no grip is'} reported, and no safety switch",
        ]

    def move(self, closed: bool) -> None:
        stuck = (
            f"{self.name} is still busy after {MOVE_SECONDS:g} s: look for what blocks its fingers, then switch it off and on"
        )
        # It ignores commands while it is busy.
        wait_for(lambda: not self._look().busy, MOVE_SECONDS, stuck)
        self._link.write(_COMMAND, [round(10 * self._force), 0 if closed else round(10000 * self._opening), _GRIP_WITH_OFFSET])
        start, moved = time.monotonic(), False

        def arrived() -> bool:
            # Before a move begins it is not busy either.
            nonlocal moved
            if self._look().busy:
                moved = True
                return False
            return moved or time.monotonic() - start > START_SECONDS

        wait_for(arrived, MOVE_SECONDS, stuck)

    def reading(self) -> float:
        state = self._look()
        self._gripped = state.gripped
        return state.opening

    def feels(self) -> bool:
        return self._gripped

    def holds(self, reading: float) -> bool:
        return super().holds(reading) and self._gripped

    def _look(self) -> _State:
        registers = self._link.read(_STATE, _STATE_COUNT)
        status = registers[10]
        tripped = [text for bit, text in _SAFETY.items() if status & 1 << bit]
        if tripped:
            raise ToolError(
                f"{self.name} has stopped for safety ({', '.join(tripped)}): free its fingers, and have a person switch its "
                "power off and on"
            )
        return _State(_signed(registers[17]) / 1e4, _signed(registers[0]) / 1e4, bool(status & _BUSY), bool(status & _GRIPPED))


class Vg10(Tool):
    """A VG10. With cups at both channels, the one with more vacuum counts: either may carry the object."""

    unit = "kPa"

    def __init__(self, section: station.Vg10):
        self._target = section.vacuum / 100 * ATMOSPHERE
        if section.threshold >= self._target:
            raise ToolError(
                f"tool.threshold is {section.threshold} kPa, and tool.vacuum is only {self._target:.1f} kPa "
                f"({section.vacuum} percent): raise the vacuum or lower the threshold"
            )
        self._section = section
        self._link = Link("VG10", section)
        self.name = self._link.name
        self._first, self._count = {"a": (0, 1), "b": (1, 1), "both": (0, 2)}[section.channel]
        self._free = [0.0] * self._count

    def connect(self) -> None:
        self._link.connect()
        self._levels()

    def close(self) -> None:
        self._link.close()

    def check(self) -> list[str]:
        channels = "ab"[self._first : self._first + self._count]
        levels = zip(channels, self._levels(), strict=True)
        return [f"{self.name}: {level:.1f} kPa below ambient in channel {channel}" for channel, level in levels]

    def prepare(self) -> None:
        self._command(_GRIP + round(self._section.vacuum))
        time.sleep(self._section.seconds)
        self._free = self._levels()
        # A cup that is not free would make every later pick a failure, silently.
        if max(self._free) + self._section.threshold > self._target:
            raise ToolError(
                f"{self.name} has {max(self._free):.1f} kPa of vacuum before the pick, and builds up {self._target:.1f}: look "
                "for an object at the cups and for dirt, or raise tool.vacuum"
            )

    def engage(self) -> None:
        time.sleep(self._section.seconds)

    def reading(self) -> float:
        return max(level - free for level, free in zip(self._levels(), self._free, strict=True))

    def holds(self, reading: float) -> bool:
        return reading > self._section.threshold

    def release(self) -> None:
        self._command(_RELEASE)
        wait_for(
            lambda: max(self._levels()) < self._section.threshold,
            RELEASE_SECONDS,
            f"{self.name} still has vacuum {RELEASE_SECONDS:g} s after it was told to let go: look for an object at the cups, "
            "and for dirt",
        )

    def _command(self, value: int) -> None:
        self._link.write(_COMMAND + self._first, [value] * self._count)

    def _levels(self) -> list[float]:
        """Kilopascals below ambient of each channel in use."""
        return [level / 1000 * ATMOSPHERE for level in self._link.read(_LEVELS + self._first, self._count)]


class _State(NamedTuple):
    opening: float
    """Metres between the fingertips."""
    offset: float
    """Metres from an aluminium finger to its fingertip's face."""
    busy: bool
    gripped: bool


def _signed(register: int) -> int:
    return register - 0x10000 if register & 0x8000 else register
