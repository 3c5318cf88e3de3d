"""The interface of tools at a station, and :func:`build`. Tools are in ``wired.py`` and ``onrobot.py``."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, Protocol

from see2act.robot.real import station
from see2act.robot.types import RobotError

POLL = 0.02
"""Seconds between two looks at something that is waited for."""
SLACK = 0.005
"""Metres by which open fingers may miss the opening of the station, and by which closing must at least move them."""
POINTED = 0.002
"""Metres between fingertips up to which they count as closed."""
WIDEST = 0.11
"""Metres between the fingers of an RG2, at most; from its data sheet."""
RELEASE_SECONDS = 3.0
"""The longest that a vacuum may take to go: a cup without blow-off on a smooth object needs long."""


class ToolError(RobotError):
    """A tool that does not answer or does not get ready, or cannot be. The message says which, and what to look at."""


class Signals(Protocol):
    """Inputs and outputs of the arm's controller."""

    def set_digital(self, channel: int, on: bool) -> None:
        """Switch an output of the cabinet."""

    def set_tool_digital(self, channel: int, on: bool) -> None:
        """Switch an output at the tool's connector."""

    def digital(self, channel: int) -> bool:
        """An input of the cabinet."""

    def analog(self, channel: int) -> float:
        """An input of the cabinet, volts."""

    def tool_analog(self, channel: int) -> float:
        """An input at the tool's connector, volts. 0 is the first, URScript's ``get_tool_analog_in(0)``."""


class Tool(ABC):
    """A tool at the flange of a real arm. To add another one, subclass this and name it in :func:`build`.

    Building one refuses numbers that cannot be, and must not touch the device: a configuration is checked by building its
    parts. What does touch the device raises :class:`ToolError` if that does not answer or does not get ready in time.
    """

    name: str
    """What messages call it, with its address."""
    unit: Literal["m", "kPa", "switch"]
    """Of the readings. A vacuum switch knows no pressure: it reads 1 with vacuum and 0 without."""
    half_opening: float = 0.0
    """Metres from the middle to each open jaw; 0 for cups."""

    @abstractmethod
    def connect(self) -> None:
        """Connect, and read once. Moves and switches nothing. The arm must be connected: some tools use its signals."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Safe to call twice, and without :meth:`connect`. The tool stays as it is, and drops nothing."""

    @abstractmethod
    def check(self) -> list[str]:
        """What can be read without moving or switching anything, a line each, for a person."""

    @abstractmethod
    def prepare(self) -> None:
        """Open; or start the pump, and remember the pressure of the free cup. Returns when done."""

    @abstractmethod
    def engage(self) -> None:
        """Close, or let the pressed cup seal. Returns when the reading is at rest."""

    @abstractmethod
    def reading(self) -> float:
        """Metres between the fingertips, or kilopascals below the pressure of the free cup; see :attr:`unit`."""

    @abstractmethod
    def holds(self, reading: float) -> bool:
        """Whether an object is held, by the latest value of :meth:`reading`."""

    @abstractmethod
    def release(self) -> None:
        """Open; or stop the pump, and blow off where that is possible. Returns when done."""


def build(section: station.Tool, signals: Signals) -> Tool:
    """The tool of a station. Does not connect.

    Args:
        section: ``tool`` of the station.
        signals: Of the arm. Tools with an address of their own do not use them.

    Raises:
        ToolError: Its numbers contradict each other, or are beyond the tool.
    """
    from see2act.robot.real.onrobot import Rg2, Vg10  # which import this module, as wired.py does
    from see2act.robot.real.wired import DigitalGripper, Ejector

    match section:
        case station.Rg2Modbus():
            return Rg2(section)
        case station.Rg2DigitalOutput():
            return DigitalGripper(section, signals)
        case station.VacuumOutput():
            return Ejector(section, signals)
        case station.Vg10():
            return Vg10(section)


def point(section: station.Tool, signals: Signals) -> None:
    """Close the fingers, so that the tool has one tip. They stay closed until the next attempt. Nothing happens to a cup.

    Raises:
        ToolError: They do not close, or there is something between them.
    """
    tool = build(section, signals)
    if not isinstance(tool, Gripper):
        return
    try:
        tool.connect()
        if tool.reading() > POINTED:
            tool.engage()
        if tool.reading() > POINTED:
            raise ToolError(f"the fingers of {tool.name} do not meet: take away what is between them")
    finally:
        tool.close()


def wait_for(ready: Callable[[], bool], seconds: float, problem: str) -> None:
    """Look until something is ready.

    Raises:
        ToolError: With the text of ``problem``, if it is not after ``seconds``.
    """
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise ToolError(problem)
        time.sleep(POLL)


class Gripper(Tool):
    """What the RG2s share: the opening between the fingertips tells whether a move was done."""

    unit = "m"
    if_open: str
    """What to do about fingers that are open though the reading denies it."""

    def __init__(self, section: station.FingersSection):
        if section.opening > WIDEST:
            raise ToolError(f"tool.opening is {section.opening} m, and an RG2 opens to {WIDEST} m: lower it")
        if section.threshold >= section.opening:
            raise ToolError(f"tool.threshold is {section.threshold} m: it must be below tool.opening, {section.opening} m")
        self._opening, self._threshold = section.opening, section.threshold
        self.half_opening = section.opening / 2

    @abstractmethod
    def move(self, closed: bool) -> None:
        """Close or open, and return when the fingers are at rest."""

    def feels(self) -> bool:
        """Whether the gripper itself said, with the latest reading, that it holds something."""
        return False

    def prepare(self) -> None:
        self.release()

    def release(self) -> None:
        self.move(closed=False)
        opening = self.reading()
        if opening < self._opening - SLACK:
            raise ToolError(
                f"{self.name} opened to {1000 * opening:.1f} mm, not to the {1000 * self._opening:.1f} mm of tool.opening: "
                f"look at its power, and for what blocks its fingers; if they are wide open, {self.if_open}"
            )

    def engage(self) -> None:
        self.move(closed=True)
        # Fingers that never moved look like fingers around a wide object.
        if self.reading() > self._opening - SLACK and not self.feels():
            raise ToolError(f"{self.name} did not close: look at its power and cable, and for what blocks its fingers")

    def holds(self, reading: float) -> bool:
        return reading > self._threshold
