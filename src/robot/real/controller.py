"""The controller of a UR arm, by the client ur_rtde: the connection, what it says of itself, its inputs and outputs."""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from see2act.robot.real.station import FingersSection, Joints, Station, matrix
from see2act.robot.types import RobotError

log = logging.getLogger("see2act")
Result = TypeVar("Result")

POLL = 0.01
"""Seconds between looks at something that is waited for."""
PATIENCE = 2.0
"""Seconds that a call of the client may take. It does not return once the link is lost."""
STALE = 0.5
"""Seconds without a message after which the link counts as lost. A controller sends 125 or 500 a second."""
SLOWEST = 0.02
"""Share of the speed below which a slider counts as zero; the controller takes no less."""
SEEN_BY_SCRIPT = 18
"""The register by which the controller hands over the voltage of a tool's input; ur_rtde leaves 18 to 22 to programs."""
ROBOT_MODES = {
    **{-1: "without a controller", 0: "disconnected", 1: "waiting for the safety settings to be confirmed", 2: "booting"},
    **{3: "powered off", 4: "powered on, with its brakes on", 5: "idle, with its brakes on", 6: "in backdrive", 7: "running"},
    8: "updating its firmware",
}
SAFETY_MODES = {
    **{1: "normal", 2: "reduced", 3: "protective stop", 4: "recovery", 5: "safeguard stop", 6: "system emergency stop"},
    **{7: "robot emergency stop", 8: "violation", 9: "fault"},
}


class ArmError(RobotError):
    """The arm cannot or must not move. It stands still."""


class ProtectiveStop(ArmError):
    """The controller stopped the arm. Only a person clears that."""


class OutOfReach(ArmError):
    """The controller says that the arm cannot be at a pose, or must not. It has not moved."""


class LinkLost(ArmError):
    """Nothing comes from the controller any more. The arm ends its present motion by itself."""


@dataclass(frozen=True)
class Status:
    """What a controller says of itself."""

    version: str
    """Of PolyScope."""
    robot_mode: str
    safety_mode: str
    remote: bool
    """Whether it takes commands from outside; always true before PolyScope 5.6, which has no such switch."""
    slider: float
    """Share of the speed."""
    joints: Joints
    tip: Float[np.ndarray, "4 4"]
    """Pose of what the controller takes for the tool's tip, in the frame of its base."""

    def objection(self) -> str | None:
        """Why the arm must not move now, and what a person can do about it; None where it may."""
        if self.safety_mode == "protective stop":
            return "the robot has made a protective stop: see what it touched, free it, and unlock it at the pendant"
        if self.safety_mode not in ("normal", "reduced"):
            return f"the robot's safety mode is {self.safety_mode}: clear it at the pendant"
        if self.robot_mode != "running":
            return f"the robot is {self.robot_mode}: switch it on and release its brakes at the pendant"
        if not self.remote:
            return "PolyScope is in local mode: switch it to remote control, top right of the pendant"
        if self.slider < SLOWEST:
            return "the speed slider stands at 0: raise it at the pendant"
        return None


class UrController:
    """A connection to the controller of a station's arm. Nothing here moves the arm.

    All poses are of the tool's tip, 4 by 4, in the frame of the controller's base.

    Args:
        station: Address and tool.
    """

    def __init__(self, station: Station):
        self._host, self._tool = station.robot.host, station.tool
        self._receive: Any = None
        self._control: Any = None
        self._io: Any = None
        self._heard = (0.0, 0.0)

    def connect(self, control: bool = True) -> None:
        """Connect; with ``control`` also take command of the arm. Nothing moves.

        Raises:
            ArmError: No controller answers, the client is not installed, or the arm must not move.
        """
        self._receive = self._made("rtde_receive", "RTDEReceiveInterface", "no controller answers")
        self._version = self._dashboard("polyscopeVersion")
        if not control:
            return
        self.check_ready()
        self._control = self._made("rtde_control", "RTDEControlInterface", "the controller runs no program of ours")
        self._io = self._made("rtde_io", "RTDEIOInterface", "the controller hands out no outputs: end other programs")
        turn = self._tool.turn if isinstance(self._tool, FingersSection) else 0.0
        tip = [0.0, 0.0, self._tool.tip, 0.0, 0.0, turn]
        self._do("setTcp", tip)
        self._do("setPayload", self._tool.mass, list(self._tool.centre_of_mass))
        if not np.allclose(self._call(self._control.getTCPOffset), tip, atol=1e-4):
            raise ArmError(f"the controller at {self._host} does not take the tool's tip from the station: restart it")

    def close(self) -> None:
        """Stop and disconnect. Safe to call twice, and after the link was lost."""
        lost = self._receive is not None and self._link_is_lost()
        for client in (self._control, self._io, self._receive):
            if client is None:
                continue
            try:
                if not lost and client is self._control:
                    self._call(client.stopScript)
                if not lost:
                    self._call(client.disconnect)
            except ArmError:
                lost = True
            if lost:
                # Its destructor would wait for ever or end the program. A further reference keeps it from being called.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))
        self._control = self._io = self._receive = None

    def status(self) -> Status:
        """Read everything, move nothing.

        Raises:
            LinkLost: The controller is silent.
        """
        return self._read(remote=self._is_remote())

    def _read(self, remote: bool) -> Status:
        self._refuse_silence()
        receive = self._receive
        return Status(
            version=self._version,
            robot_mode=ROBOT_MODES.get(int(receive.getRobotMode()), "in an unknown mode"),
            safety_mode=SAFETY_MODES.get(int(receive.getSafetyMode()), "unknown"),
            remote=remote,
            slider=float(receive.getTargetSpeedFraction()),
            joints=self.joints,
            tip=self.tip,
        )

    @property
    def joints(self) -> Joints:
        """Actual joint angles, radians."""
        return tuple(self._receive.getActualQ())

    @property
    def tip(self) -> Float[np.ndarray, "4 4"]:
        """Actual pose."""
        return matrix(tuple(self._receive.getActualTCPPose()))

    @property
    def force(self) -> Float[np.ndarray, "3"]:
        """Force on the tip in newtons, as the controller estimates it from the motors' currents."""
        return np.array(self._receive.getActualTCPForce()[:3])

    # Whether the arm may move

    def check_ready(self) -> None:
        """Refuse to move in the wrong mode, and start the controller's program again where it has ended. Nothing moves.

        Raises:
            ArmError: The arm must not move; :class:`ProtectiveStop` where nobody has cleared one.
        """
        _refuse(self.status())
        if self._control is not None and not self._call(self._control.isProgramRunning):
            log.info("the controller's program had ended, and is started again")
            self._call(self._control.reuploadScript)
            self._wait(self._control.isProgramRunning, "its program")

    def _refuse_to_go_on(self) -> None:
        """In the middle of a motion. The dashboard, which is slow, was asked before it."""
        _refuse(self._read(remote=True))
        if not self._call(self._control.isProgramRunning):
            deadline = time.monotonic() + STALE
            while time.monotonic() < deadline:  # a protective stop ends the program too, and its news may come later
                time.sleep(POLL)
                _refuse(self._read(remote=True))
            raise ArmError("the controller's program was ended at the pendant: type the same command again")

    def _refuse_silence(self) -> None:
        if self._link_is_lost():
            raise LinkLost(f"nothing comes from the controller at {self._host} any more: see to its cable, and start again")

    def _link_is_lost(self) -> bool:
        sent, now = self._receive.getTimestamp(), time.monotonic()
        if sent != self._heard[0]:
            self._heard = (sent, now)
        return now - self._heard[1] > STALE

    # Inputs and outputs

    def set_digital(self, channel: int, on: bool) -> None:
        """Switch a digital output of the cabinet."""
        self._call(self._io.setStandardDigitalOut, channel, on)

    def set_tool_digital(self, channel: int, on: bool) -> None:
        """Switch a digital output at the tool."""
        self._call(self._io.setToolDigitalOut, channel, on)

    def digital(self, channel: int) -> bool:
        """Level of a digital input of the cabinet."""
        self._refuse_silence()
        return bool(self._receive.getActualDigitalInputBits() >> channel & 1)

    def analog(self, channel: int) -> float:
        """Volts at an analog input of the cabinet."""
        self._refuse_silence()
        return float((self._receive.getStandardAnalogInput0, self._receive.getStandardAnalogInput1)[channel]())

    def tool_analog(self, channel: int) -> float:
        """Volts at an analog input of the tool, which the client cannot read: a secondary program of the controller can.

        Such a program runs beside the main one and does not disturb it.
        """
        self._refuse_silence()
        client = _library("script_client").ScriptClient(self._host, *map(int, self._version.split(".")[:2]))
        register = SEEN_BY_SCRIPT + channel
        program = f"sec read_tool():\n  write_output_float_register({register}, get_tool_analog_in({channel}))\nend\n"
        self._call(client.connect)
        self._call(client.sendScriptCommand, program)
        time.sleep(5 * POLL)  # one cycle of the controller, and one message
        self._call(client.disconnect)
        return float(self._receive.getOutputDoubleRegister(register))

    # Calls of the client

    def _do(self, method: str, *arguments: object) -> None:
        """A command that must succeed. The client says False, and raises nothing, where it did not."""
        if not self._call(getattr(self._control, method), *arguments):
            self._refuse_to_go_on()
            raise ArmError(f"the controller has refused {method}: read its log at the pendant")

    def _ask(self, method: str, *arguments: object) -> bool:
        """A question; False may also mean that nobody answers."""
        yes = bool(self._call(getattr(self._control, method), *arguments))
        self._refuse_to_go_on()
        return yes

    def _call(self, function: Callable[..., Result], *arguments: object) -> Result:
        """Call the client in a thread, since with a lost link it may never return."""
        done: list[Result] = []
        failed: list[Exception] = []

        def work() -> None:
            try:
                done.append(function(*arguments))
            except Exception as error:
                failed.append(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(PATIENCE)
        if failed:
            raise ArmError(f"the controller at {self._host}: {' '.join(str(failed[0]).split())}")
        if not done:
            raise LinkLost(f"the controller at {self._host} does not answer any more: see to its cable, and start again")
        return done[0]

    def _made(self, module: str, name: str, trouble: str) -> Any:
        try:
            client = getattr(_library(module), name)(self._host)
        except RuntimeError as error:
            raise ArmError(
                f"{trouble} at {self._host} ({' '.join(str(error).split())}): check the address in the station and the cable"
            ) from None
        self._heard = (0.0, time.monotonic())
        return client

    def _dashboard(self, question: str) -> Any:
        client = _library("dashboard_client").DashboardClient(self._host)
        try:
            self._call(client.connect)
            return self._call(getattr(client, question))
        finally:
            client.disconnect()

    def _is_remote(self) -> bool:
        newer = tuple(map(int, self._version.split(".")[:2])) >= (5, 6)
        return bool(self._dashboard("isInRemoteControl")) if newer else True

    def _wait(self, ready: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not ready():
            if time.monotonic() > deadline:
                raise ArmError(f"the controller at {self._host} does not take {what}: restart it")
            time.sleep(POLL)


def _refuse(status: Status) -> None:
    if reason := status.objection():
        raise (ProtectiveStop if status.safety_mode == "protective stop" else ArmError)(reason)


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise ArmError("robot=ur5_real needs the package ur-rtde: pip install 'see2act[real]'") from None
