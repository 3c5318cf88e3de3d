"""A stand-in for the controller of a UR5: as much of its dashboard, script port and RTDE as the client ur_rtde uses.

The protocol is that of Universal Robots' "Real-Time Data Exchange (RTDE) Guide"; the commands are those of the control script
that ur_rtde 1.6.5 uploads. The script itself is not run: its commands are obeyed here.
"""

from __future__ import annotations

import re
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from ur_analytic_ik import ur5

from see2act.robot.real.station import matrix, pose

DASHBOARD, SCRIPTS, RTDE = 29999, (30001, 30002, 30003), 30004
"""Ports of a controller."""
HZ = 125
"""Messages a second of a CB3."""
RUNNING, NORMAL, PROTECTIVE_STOP = 7, 1, 3
"""Robot mode; safety modes."""
UNANSWERED = (6, 9, 10, 11, 24, 25, 26, 27, 38, 58)
"""Commands that the control script does not report as done, and the client does not wait for."""
HOME = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
"""Joints at the start, radians."""
_VECTORS = (
    *("target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd", "actual_current"),
    *("joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force", "target_TCP_pose", "target_TCP_speed"),
    *("joint_temperatures", "actual_joint_voltage", "payload_inertia", "ft_raw_wrench", "external_force_torque"),
)
_TYPES = {
    **dict.fromkeys(_VECTORS, "VECTOR6D"),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits", "speed_slider_mask"), "UINT32"),
    **dict.fromkeys(("robot_mode", "safety_mode", "tool_mode"), "INT32"),
    **dict.fromkeys(("actual_tool_accelerometer", "payload_cog"), "VECTOR3D"),
    "joint_mode": "VECTOR6INT32",
    "standard_analog_output_type": "UINT8",
}
"""RTDE's type of each variable; of those not named here :func:`_type` knows it by the name."""
_FORMATS = {
    **{"VECTOR6D": "6d", "VECTOR3D": "3d", "VECTOR6INT32": "6i", "DOUBLE": "d"},
    **{"UINT64": "Q", "UINT32": "I", "INT32": "i", "UINT8": "B", "BOOL": "?"},
}


@dataclass
class State:
    """What the controller would show. Tests set it; the servers and :meth:`Controller.step` use it."""

    q: Float[np.ndarray, "6"] = field(default_factory=lambda: np.array(HOME))
    robot_mode: int = RUNNING
    safety_mode: int = NORMAL
    remote: bool = True
    version: tuple[int, int, int] = (3, 15, 8)
    slider: float = 1.0
    """Share of the speed that the slider leaves."""
    program: bool = False
    """Whether the control script runs."""
    outputs: int = 0
    """Digital outputs, a bit each: 0 to 7 in the cabinet, 16 and 17 at the tool."""
    inputs: int = 0
    """Digital inputs, a bit each."""
    analog: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Volts at the cabinet."""
    tool_analog: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Volts at the tool."""
    force: list[float] = field(default_factory=lambda: [0.0] * 6)
    """Newtons and newton metres at the tool's tip."""
    tcp: list[float] = field(default_factory=lambda: [0.0] * 6)
    """Pose of the tool's tip in the frame of the flange."""
    speed: float = 0.0
    """Of the last motion that was commanded, m/s or rad/s."""
    freedrive: bool = False
    refuse_moves: bool = False
    """Whether moves are accepted and never begin."""
    off_by: float = 0.0
    """Metres by which straight moves end too high."""


class Controller:
    """Serves one client at an address until closed. Nothing moves but in :meth:`step`.

    Args:
        host: Address to serve at, 127.0.0.N. The ports are those of a real controller.
    """

    def __init__(self, host: str):
        self.state = State()
        self.log: list[str] = []
        """Commands received, for tests."""
        self._lock = threading.RLock()
        self._open = True
        self._linked = True
        self._registers: dict[str, Any] = {}
        self._move: _Move | None = None
        self._operation = self._changes = 0
        self._sockets = [self._listen(host, DASHBOARD, self._dashboard), self._listen(host, RTDE, self._rtde)]
        self._sockets += [self._listen(host, port, self._scripts) for port in SCRIPTS]
        self._clients: list[socket.socket] = []

    def close(self) -> None:
        """End all connections, as a controller that loses its power does."""
        self._open = False
        for each in (*self._sockets, *self._clients):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
                each.close()

    def cut(self) -> None:
        """Pull the network cable: connections stay open, nothing arrives any more, and new connections are refused."""
        self._linked = False
        for server in self._sockets:
            server.shutdown(socket.SHUT_RDWR)
            server.close()

    def step(self, seconds: float) -> None:
        """Let time pass."""
        with self._lock:
            if self._move is None or self.state.refuse_moves:
                return
            joints = self._move.after(seconds * self.state.slider)
            if joints is None:
                self._script_dies()
                return
            self.state.q = joints
            if self._move.over:
                if not self._move.background:
                    self._set("output_int_register_0", 2)
                self._stop_moving()

    def protective_stop(self) -> None:
        """As after a collision."""
        with self._lock:
            self.state.safety_mode = PROTECTIVE_STOP
            self._script_dies()

    def kill_script(self) -> None:
        """As when a person stops the program at the pendant."""
        with self._lock:
            self._script_dies()

    @property
    def moving(self) -> bool:
        """Whether a motion is under way."""
        return self._move is not None

    # Dashboard

    def _dashboard(self, client: socket.socket) -> None:
        client.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in client.makefile("r"):
            command = line.strip()
            self.log.append(f"dashboard: {command}")
            with self._lock:
                client.sendall(f"{self._answer(command)}\n".encode())

    def _answer(self, command: str) -> str:
        state = self.state
        if command == "stop":
            self._script_dies()
            return "Stopped"
        if command == "unlock protective stop":
            state.safety_mode = NORMAL
            return "Protective stop releasing"
        mode = {3: "POWER_OFF", 5: "IDLE", RUNNING: "RUNNING"}.get(state.robot_mode, "NO_CONTROLLER")
        safety = {NORMAL: "NORMAL", 2: "REDUCED", PROTECTIVE_STOP: "PROTECTIVE_STOP"}.get(state.safety_mode, "FAULT")
        version = ".".join(str(part) for part in state.version)
        return {
            "robotmode": f"Robotmode: {mode}",
            "safetymode": f"Safetymode: {safety}",
            "safetystatus": f"Safetystatus: {safety}",
            "PolyscopeVersion": f"URSoftware {version}.106339 (Jan 01 2024)",
            "is in remote control": str(state.remote).lower(),
            "running": f"Program running: {str(state.program).lower()}",
            "get serial number": "20173550000",
            "get robot model": "UR5",
            "quit": "Disconnected",
        }.get(command, "ok")

    # Scripts

    def _scripts(self, client: socket.socket) -> None:
        received = b""
        while chunk := client.recv(65536):
            received += chunk
            text = received.decode(errors="replace")
            if not re.search(r"^end\s*$", text, re.MULTILINE) or not text.endswith("\n"):
                continue
            received = b""
            self.log.append(f"script: {len(text)} characters")
            with self._lock:
                if text.lstrip().startswith("sec "):
                    self._secondary(text)
                elif self.state.safety_mode in (NORMAL, 2) and self.state.robot_mode == RUNNING:
                    self._script_starts()

    def _secondary(self, text: str) -> None:
        """A secondary program that copies an analog input of the tool to a register, the only one that is understood."""
        found = re.search(r"write_output_float_register\((\d+), *get_tool_analog_in\((\d)\)\)", text)
        if found:
            self._set(f"output_double_register_{found[1]}", self.state.tool_analog[int(found[2]) % 2])

    def _script_starts(self) -> None:
        self.state.program = True
        self._set("output_int_register_0", 1)

    def _script_dies(self) -> None:
        self._stop_moving()
        self.state.program = False
        self._set("output_int_register_0", 0)

    # RTDE

    def _rtde(self, client: socket.socket) -> None:
        stream = client.makefile("rb")
        recipes: list[list[str]] = []
        outputs: list[str] = []
        sending = threading.Event()

        def send(kind: str, payload: bytes) -> None:
            client.sendall(struct.pack(">HB", len(payload) + 3, ord(kind)) + payload)

        def publish() -> None:
            with suppress(OSError):
                while self._open and sending.is_set():
                    if self._linked:
                        with self._lock:
                            send("U", b"\x01" + b"".join(_packed(name, self._value(name)) for name in outputs))
                    time.sleep(1 / HZ)

        try:
            while header := stream.read(3):
                size, kind = struct.unpack(">HB", header)
                body = stream.read(size - 3)
                if not self._linked:
                    continue
                if chr(kind) == "V":
                    send("V", b"\x01")
                elif chr(kind) == "v":
                    send("v", struct.pack(">4I", *self.state.version, 0))
                elif chr(kind) == "O":
                    outputs = [name for name in body[8:].decode().split(",") if name]
                    send("O", b"\x01" + ",".join(map(_type, outputs)).encode())
                elif chr(kind) == "I":
                    recipes.append([name for name in body.decode().split(",") if name])
                    send("I", bytes([len(recipes)]) + ",".join(map(_type, recipes[-1])).encode())
                elif chr(kind) == "S":
                    send("S", b"\x01")
                    if not sending.is_set():
                        sending.set()
                        threading.Thread(target=publish, daemon=True).start()
                elif chr(kind) == "P":
                    sending.clear()
                    send("P", b"\x01")
                elif chr(kind) == "U":
                    with self._lock:
                        self._write(recipes[body[0] - 1], body[1:])
        finally:
            sending.clear()

    def _value(self, name: str) -> Any:
        state = self.state
        known: dict[str, Callable[[], Any]] = {
            "timestamp": time.monotonic,
            "target_q": lambda: state.q,
            "actual_q": lambda: state.q,
            "actual_TCP_pose": self.tip,
            "target_TCP_pose": self.tip,
            "actual_TCP_force": lambda: state.force,
            "robot_mode": lambda: state.robot_mode,
            "safety_mode": lambda: state.safety_mode,
            "runtime_state": lambda: 2 if state.program else 1,
            "robot_status_bits": lambda: 1 + 2 * state.program,
            "safety_status_bits": lambda: {NORMAL: 1, 2: 2, PROTECTIVE_STOP: 4}.get(state.safety_mode, 0),
            "speed_scaling": lambda: state.slider,
            "target_speed_fraction": lambda: state.slider,
            "actual_digital_output_bits": lambda: state.outputs,
            "actual_digital_input_bits": lambda: state.inputs,
            "standard_analog_input0": lambda: state.analog[0],
            "standard_analog_input1": lambda: state.analog[1],
        }
        if name in known:
            return known[name]()
        size = _FORMATS[_type(name)][:-1]
        return self._registers.get(name, [0] * int(size) if size else 0)

    def _write(self, names: list[str], body: bytes) -> None:
        """Inputs that the client sends."""
        at = 0
        for name in names:
            form = ">" + _FORMATS[_type(name)]
            if at + struct.calcsize(form) > len(body):
                break
            values = struct.unpack_from(form, body, at)
            at += struct.calcsize(form)
            self._registers[name] = values[0] if len(values) == 1 else list(values)
        if "standard_digital_output_mask" in names:
            self._switch(int(self._get("standard_digital_output_mask")), int(self._get("standard_digital_output")))
        if "tool_digital_output_mask" in names:
            self._switch(int(self._get("tool_digital_output_mask")) << 16, int(self._get("tool_digital_output")) << 16)
        if "input_int_register_0" in names and self.state.program:
            command = int(self._get("input_int_register_0"))
            if command == 0:
                self._set("output_int_register_0", 1)
            elif self._get("output_int_register_0") == 1:
                self.log.append(f"command {command}")
                self._obey(command)

    def _switch(self, mask: int, levels: int) -> None:
        self.state.outputs = (self.state.outputs & ~mask) | (levels & mask)

    # Commands of the control script

    def _obey(self, command: int) -> None:
        state = self.state
        if command in (1, 2, 3, 4):
            self._start_moving(command)
            return
        if command in (30, 46):  # inverse kinematics, near given joints or the present ones
            near = np.array(self._doubles(6, 6)) if command == 30 else state.q
            joints = self.joints_at(np.array(self._doubles(0, 6)), near)
            if joints is None:
                self._script_dies()  # as URScript's get_inverse_kin does
                return
            self._return(joints)
        elif command == 17:
            self._registers["payload"] = self._doubles(0, 1)[0]
        elif command == 29:
            state.tcp = self._doubles(0, 6)
        elif command == 31:
            self.protective_stop()
            return
        elif command in (33, 34):
            self._stop_moving()
        elif command == 36:
            reachable = self.joints_at(np.array(self._doubles(0, 6)), state.q) is not None
            self._set("output_int_register_1", int(reachable))
        elif command == 37:
            self._set("output_int_register_1", 1)
        elif command == 40:
            self._return(state.tcp)
        elif command == 43:
            self._return(self.tip())
        elif command == 47:
            self._set("output_int_register_1", int(self._move is None))
        elif command in (52, 53):
            state.freedrive = command == 52
        elif command in (60, 61):
            near = np.array(self._doubles(6, 6)) if command == 61 else state.q
            self._set("output_int_register_1", int(self.joints_at(np.array(self._doubles(0, 6)), near) is not None))
        elif command in UNANSWERED:
            return
        elif command == 255:
            self._stop_moving()
            state.program = False
        self._set("output_int_register_0", 2)

    def _start_moving(self, command: int) -> None:
        """1: joints, 2: to a pose by joints, 3: to a pose in a straight line, 4: to joints in a straight line."""
        target, (speed, _) = np.array(self._doubles(0, 6)), self._doubles(6, 2)
        self.state.speed = speed
        if command == 3:
            target[2] += self.state.off_by
        joints = target if command in (1, 4) else self.joints_at(target, self.state.q)
        if joints is None:
            self._script_dies()
            return
        background = bool(self._get("input_int_register_1"))
        if command in (1, 2):
            self._move = _JointMove(self.state.q, joints, speed, background)
        else:
            goal = target if command == 3 else self.tip(joints)
            self._move = _LineMove(self.tip(), goal, speed, background, self.joints_at, self.state.q)
        if background:
            self._operation = (self._operation + 1) % 128
            self._report_progress(running=True)
            self._set("output_int_register_0", 2)

    def _stop_moving(self) -> None:
        self._move = None
        self._report_progress(running=False)

    def _report_progress(self, running: bool) -> None:
        """Register 2 of the script: bits 24 to 30 number the operation, bit 15 says that it runs."""
        self._changes = (self._changes + 1) % 128
        self._set("output_int_register_2", (self._operation << 24) + (self._changes << 16) + (running << 15))

    def tip(self, joints: np.ndarray | None = None) -> np.ndarray:
        """Pose of the tool's tip."""
        flange = np.array(ur5.forward_kinematics(*(self.state.q if joints is None else joints)))
        return np.array([*pose(flange @ matrix(self.state.tcp))])

    def joints_at(self, tip: np.ndarray, near: np.ndarray) -> np.ndarray | None:
        """The joints nearest to given ones with the tip at a pose; None where there are none."""
        flange = matrix(tip) @ np.linalg.inv(matrix(self.state.tcp))
        found = [near + (np.array(q) - near + np.pi) % (2 * np.pi) - np.pi for q in ur5.inverse_kinematics(flange)]
        return min(found, key=lambda q: float(np.abs(q - near).max()), default=None)

    def _get(self, name: str) -> Any:
        return self._registers.get(name, 0)

    def _set(self, name: str, value: float) -> None:
        self._registers[name] = value

    def _doubles(self, first: int, count: int) -> list[float]:
        return [self._get(f"input_double_register_{i}") for i in range(first, first + count)]

    def _return(self, values: Any) -> None:
        for i, value in enumerate(values):
            self._set(f"output_double_register_{i}", float(value))

    # Connections

    def _listen(self, host: str, port: int, serve: Callable[[socket.socket], None]) -> socket.socket:
        server = socket.socket()
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((host, port))
        server.listen()
        threading.Thread(target=self._accept, args=(server, serve), daemon=True).start()
        return server

    def _accept(self, server: socket.socket, serve: Callable[[socket.socket], None]) -> None:
        with suppress(OSError):
            while self._open:
                client, _ = server.accept()
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._clients.append(client)
                threading.Thread(target=self._serve, args=(serve, client), daemon=True).start()

    def _serve(self, serve: Callable[[socket.socket], None], client: socket.socket) -> None:
        with client, suppress(OSError, ValueError):
            serve(client)


class _Move(ABC):
    """A motion with smooth ends; its peak speed is the one commanded."""

    def __init__(self, length: float, speed: float, background: bool):
        self.background = background
        self._seconds = max(length / speed * np.pi / 2, 1e-3)
        self._passed = 0.0

    @property
    def over(self) -> bool:
        return self._passed >= self._seconds

    def after(self, seconds: float) -> np.ndarray | None:
        """Joints when so much time has passed; None where there are none."""
        self._passed += seconds
        return self._joints((1 - np.cos(np.pi * min(1.0, self._passed / self._seconds))) / 2)

    @abstractmethod
    def _joints(self, share: float) -> np.ndarray | None:
        """Joints after a share of the way; None where there are none."""


class _JointMove(_Move):
    def __init__(self, start: np.ndarray, end: np.ndarray, speed: float, background: bool):
        super().__init__(float(np.abs(end - start).max()), speed, background)
        self._start, self._end = start.copy(), end

    def _joints(self, share: float) -> np.ndarray:
        joints: np.ndarray = self._start + share * (self._end - self._start)
        return joints


class _LineMove(_Move):
    def __init__(self, start: np.ndarray, end: np.ndarray, speed: float, background: bool, solve: Callable, near: np.ndarray):
        turn = (Rotation.from_rotvec(start[3:]).inv() * Rotation.from_rotvec(end[3:])).as_rotvec()
        super().__init__(max(float(np.linalg.norm(end[:3] - start[:3])), 0.1 * float(np.linalg.norm(turn))), speed, background)
        self._start, self._end, self._turn = start, end, turn
        self._solve, self._near = solve, near.copy()

    def _joints(self, share: float) -> np.ndarray | None:
        rotation = Rotation.from_rotvec(self._start[3:]) * Rotation.from_rotvec(share * self._turn)
        position = self._start[:3] + share * (self._end[:3] - self._start[:3])
        joints: np.ndarray | None = self._solve(np.concatenate([position, rotation.as_rotvec()]), self._near)
        if joints is not None:
            self._near = joints
        return joints


def _type(name: str) -> str:
    if name in _TYPES:
        return _TYPES[name]
    if "int_register" in name:
        return "INT32"
    if "bit_register" in name:
        return "BOOL"
    return "UINT8" if "digital_output" in name or name.endswith("_mask") else "DOUBLE"


def _packed(name: str, value: Any) -> bytes:
    return struct.pack(">" + _FORMATS[_type(name)], *np.ravel(value).tolist())
