"""The tools at a stand-in's station: the simulated cup and gripper behind the signals and registers of real ones."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod

from benchmarks.stand_in.controller import State
from benchmarks.stand_in.modbus import ComputeBox, Rg2
from see2act.robot.end_effector import EndEffector
from see2act.robot.gripper import CLOSED, FLOOR_GAP, OPEN, Gripper
from see2act.robot.real import station
from see2act.robot.suction import SuctionCup

SEAL_EVERY = 12
"""Timesteps between a resting cup's trials to seal: 50 ms."""
VOLTS = (1.0, 5.0)
"""Of the pressure sensor at ambient pressure, and at 100 kPa below it."""
BOX_PORT = 5020
"""Of the Compute Box. The real one has 502, which only an administrator may serve."""


class StandInTool(ABC):
    """A simulated tool that is switched as a real one is."""

    section: station.Tool
    """What the station's file says of it."""

    @property
    @abstractmethod
    def active(self) -> bool:
        """Whether it holds something, or moves: then time must pass in the simulation."""

    @abstractmethod
    def reset(self) -> None:
        """Begin again, since the simulated tool was built anew."""

    @abstractmethod
    def step(self, at_rest: bool) -> bool:
        """After a timestep, obey what was commanded. Returns whether the tool has just let go.

        Args:
            at_rest: Whether the arm stands still.
        """


class StandInCup(StandInTool):
    """A cup whose pump is at the controller's first output, and its pressure sensor at the first analog input.

    Args:
        cup: Simulated.
        state: Of the controller.
    """

    def __init__(self, cup: SuctionCup, state: State):
        self._cup, self._state = cup, state
        self._steps = 0
        self.section = station.VacuumOutput(
            tip=cup.length(), mass=0.5, depth=cup.press, floor_gap=0.0005, analog=0, volts=VOLTS, seconds=1.0, threshold=20.0
        )
        self.reset()

    @property
    def active(self) -> bool:
        return self._on or self._commanded

    def reset(self) -> None:
        self._on = self._sealed = False

    def step(self, at_rest: bool) -> bool:
        self._steps += 1
        switched = self._commanded != self._on
        if switched:
            self._on, self._sealed = self._commanded, False
            if self._on:
                self._cup.prepare()
            else:
                self._cup.release()
        if self._on and not self._sealed and at_rest and self._steps % SEAL_EVERY == 0:
            self._cup.engage()
            self._sealed = self._cup.engaged()
        self._cup.update_hold()
        kilopascals = self._cup.pressure if self._on else 0.0
        self._state.analog[0] = VOLTS[0] + (VOLTS[1] - VOLTS[0]) * kilopascals / 100
        return switched and not self._on

    @property
    def _commanded(self) -> bool:
        return bool(self._state.outputs & 1)


class StandInGripper(StandInTool):
    """A gripper at a Compute Box, which answers as an RG2.

    Args:
        gripper: Simulated.
        host: Address of the box.
    """

    def __init__(self, gripper: Gripper, host: str):
        self._fingers = _Fingers(gripper)
        ComputeBox(self._fingers, host, BOX_PORT)  # serves until the process ends
        self.section = station.Rg2Modbus(
            host=host,
            port=BOX_PORT,
            tip=gripper.length() + gripper.reach(),
            mass=0.9,
            depth=gripper.depth + gripper.reach(),
            floor_gap=FLOOR_GAP,
            opening=2 * gripper.half_opening,
            threshold=gripper.threshold,
        )

    @property
    def active(self) -> bool:
        return self._fingers.active

    def reset(self) -> None:
        self._fingers.reset()

    def step(self, at_rest: bool) -> bool:
        return self._fingers.step()


class _Fingers(Rg2):
    """Registers whose fingers are those of the simulation. They can only open and close all the way."""

    def __init__(self, gripper: Gripper):
        super().__init__(widest=2 * gripper.half_opening, offset=0.0)
        self._gripper = gripper
        self.reset()

    @property
    def active(self) -> bool:
        return self._closed or self._moving or self._wanted

    def reset(self) -> None:
        with self._lock:
            self._closed = self._moving = False
            self._target = self._opening = self.widest

    def step(self) -> bool:
        """Returns whether the fingers have just come to rest open."""
        with self._lock:
            if self._wanted != self._closed and time.monotonic() >= self._start:
                self._closed, self._moving = self._wanted, True
                self._gripper.drive(CLOSED if self._closed else OPEN)
            self._gripper.update_hold()
            arrived = self._moving and self._gripper.still()
            self._moving = self._moving and not arrived
            self._opening = self._gripper.present_opening()
            return arrived and not self._closed

    @property
    def _wanted(self) -> bool:
        return self._target < self.widest / 2

    def _advance(self) -> None:
        """Time passes in :meth:`step`."""

    def _busy(self) -> bool:
        return self._moving or (self._wanted != self._closed and time.monotonic() >= self._start)

    def _gripped(self) -> bool:
        return self._closed and not self._moving  # fingertips that press on each other report a grip too


def stand_in_for(tool: EndEffector, state: State, host: str) -> StandInTool:
    """Make a station's tool of a simulated one."""
    if isinstance(tool, SuctionCup):
        return StandInCup(tool, state)
    assert isinstance(tool, Gripper)
    return StandInGripper(tool, host)
