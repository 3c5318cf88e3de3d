"""A stand-in for an OnRobot Compute Box with an RG2 or a VG10: a Modbus TCP server with their registers, on this machine.

The messages are those of the "MODBUS Messaging on TCP/IP Implementation Guide", written out here: a server of the client's own
library would share its mistakes. The registers are those of OnRobot's "Connectivity guide".
"""

from __future__ import annotations

import math
import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

READ, WRITE_ONE, WRITE = 3, 6, 16
"""Function codes."""
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
"""Exception codes."""
CURRENT_LIMIT = 500
"""Milliamperes, a VG10's default."""
FREE = 0.03
"""Share of a full vacuum that a VG10 reaches with a free cup."""


class Registers(Protocol):
    """What a tool offers to the box."""

    def read(self, address: int) -> int:
        """A register, 16 bits. Raises KeyError where there is none."""

    def write(self, values: dict[int, int]) -> None:
        """Obey a message. Raises KeyError where there is no such register."""


class Rg2:
    """The fingers of an RG2. They move in time, and stop at what is between them.

    Args:
        between: Metres between the fingertips that an object keeps open; 0 for none. Asked whenever the fingers could move.
        speed: Metres a second.
        delay: Seconds after a command before the fingers move and the busy bit is set.
        widest: Metres between the fingertips, at most.
        offset: Metres that each fingertip takes, with its sign.
    """

    def __init__(
        self,
        between: Callable[[], float] = lambda: 0.0,
        speed: float = 0.1,
        delay: float = 0.03,
        widest: float = 0.1054,
        offset: float = 0.0046,
    ):
        self.between, self.speed, self.delay, self.widest, self.offset = between, speed, delay, widest, offset
        self.safety = 0
        """Safety bits of the status, 2 to 6. With any of them set the fingers stay where they are."""
        self.force = 0.0
        """Newtons of the latest command that was obeyed."""
        self.commands = 0
        """How many moves were obeyed. While the fingers move, none is."""
        self._command = [0, 0, 0]
        self._target = self._opening = widest
        self._start = self._last = time.monotonic()
        self._lock = threading.Lock()

    @property
    def opening(self) -> float:
        """Metres between the fingertips now."""
        with self._lock:
            self._advance()
            return self._opening

    def read(self, address: int) -> int:
        with self._lock:
            self._advance()
            if 0 <= address <= 2:
                return self._command[address]
            if not 258 <= address <= 275:
                raise KeyError(address)
            known = {
                258: round(1e4 * self.offset),
                267: round(1e4 * (self._opening + 2 * self.offset)),
                268: self._busy() | self._gripped() << 1 | self.safety,
                275: round(1e4 * self._opening),
            }
            return known.get(address, 0) & 0xFFFF

    def write(self, values: dict[int, int]) -> None:
        with self._lock:
            self._advance()
            if max(values) > 2:
                raise KeyError(max(values))
            for address, value in values.items():
                self._command[address] = value
            control = values.get(2)
            if control == 8:
                self._target = self._opening
            elif control in (1, 16) and not self._busy() and not self.safety:
                width = self._command[1] / 1e4 - (2 * self.offset if control == 1 else 0)
                self._target = min(width, self.widest)
                self.force = self._command[0] / 10
                self._start = time.monotonic() + self.delay
                self.commands += 1

    def _goal(self) -> float:
        """Where the fingers come to rest."""
        if self.safety:
            return self._opening
        return max(self._target, min(self.between(), self._opening))

    def _advance(self) -> None:
        now = time.monotonic()
        step = self.speed * max(0.0, now - max(self._last, self._start))
        self._last = now
        goal = self._goal()
        way = goal - self._opening
        self._opening = goal if abs(way) <= step else self._opening + math.copysign(step, way)

    def _busy(self) -> bool:
        return time.monotonic() >= self._start and self._goal() != self._opening

    def _gripped(self) -> bool:
        return not self._busy() and self._opening > self._target and self._opening == self.between()


class Vg10:
    """The two air channels of a VG10. Their vacuum comes and goes in time.

    Args:
        sealed: Whether the cups of a channel, "a" or "b", are closed by an object. Asked whenever the vacuum could change.
        seconds: Time constant of the vacuum.
    """

    def __init__(self, sealed: Callable[[str], bool] = lambda channel: False, seconds: float = 0.05):
        self.sealed, self.seconds = sealed, seconds
        self._command = [0, 0]
        self._levels = [0.0, 0.0]
        self._last = time.monotonic()
        self._lock = threading.Lock()

    def gripping(self, channel: str) -> bool:
        """Whether a channel was told to build up vacuum."""
        return self._command["ab".index(channel)] >> 8 == 1

    def read(self, address: int) -> int:
        with self._lock:
            self._advance()
            known = {0: self._command[0], 1: self._command[1], 2: CURRENT_LIMIT}
            known |= {258 + i: round(1000 * level) for i, level in enumerate(self._levels)}
            return known[address]

    def write(self, values: dict[int, int]) -> None:
        with self._lock:
            self._advance()
            if max(values) > 1:
                raise KeyError(max(values))
            for address, value in values.items():
                self._command[address] = value

    def _advance(self) -> None:
        now = time.monotonic()
        share = 1 - math.exp(-(now - self._last) / self.seconds)
        self._last = now
        for i, command in enumerate(self._command):
            mode, target, sealed = command >> 8, (command & 0xFF) / 100, self.sealed("ab"[i])
            goal = 0.0
            if mode == 1:
                goal = target if sealed else min(target, FREE)
            elif mode == 2 and sealed:  # idle: an object stays where it is
                goal = self._levels[i]
            self._levels[i] += share * (goal - self._levels[i])


class ComputeBox:
    """Serves one tool, and one client at a time as the real box does; others wait.

    Args:
        tool: What is mounted.
        host: Address to serve at, 127.0.0.N.
        port: 0 for one that is free.
        unit: Of the tool. Other units get no answer.
    """

    def __init__(self, tool: Registers, host: str = "127.0.0.1", port: int = 0, unit: int = 65):
        self.tool, self.unit = tool, unit
        self.silent = False
        """Receive, and do not answer: what a client sees when a cable was pulled."""
        self._client: socket.socket | None = None
        self._server = socketserver.TCPServer((host, port), _handler(self), bind_and_activate=False)
        self._server.allow_reuse_address = True
        self._server.server_bind()
        self._server.server_activate()
        self.host, self.port = host, int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def __enter__(self) -> ComputeBox:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def cut(self) -> None:
        """Close the client's connection. The box still listens."""
        if self._client is not None:
            with suppress(OSError):
                self._client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Stop serving. Safe to call twice."""
        if not self._thread.is_alive():
            return
        stopper = threading.Thread(target=self._server.shutdown)
        stopper.start()
        while stopper.is_alive():  # a client may come in between
            self.cut()
            stopper.join(0.02)
        self._thread.join()
        self._server.server_close()

    def serve(self, client: socket.socket) -> None:
        """Answer a client until it goes."""
        self._client = client
        with suppress(OSError), client.makefile("rb") as stream:
            while len(header := stream.read(7)) == 7:
                transaction, _, length, unit = struct.unpack(">HHHB", header)
                request = stream.read(length - 1)
                if unit == self.unit and not self.silent:
                    answer = self._answer(request)
                    client.sendall(struct.pack(">HHHB", transaction, 0, len(answer) + 1, unit) + answer)
        self._client = None

    def _answer(self, request: bytes) -> bytes:
        function = request[0]
        try:
            if function == READ:
                first, count = struct.unpack(">HH", request[1:])
                values = [self.tool.read(address) for address in range(first, first + count)]
                return struct.pack(f">BB{count}H", function, 2 * count, *values)
            if function == WRITE_ONE:
                address, value = struct.unpack(">HH", request[1:])
                self.tool.write({address: value})
                return request
            if function == WRITE:
                first, count = struct.unpack(">HH", request[1:5])
                self.tool.write(dict(enumerate(struct.unpack(f">{count}H", request[6:]), first)))
                return request[:5]
        except KeyError:
            return bytes([function | 0x80, ILLEGAL_ADDRESS])
        return bytes([function | 0x80, ILLEGAL_FUNCTION])


def _handler(box: ComputeBox) -> type[socketserver.BaseRequestHandler]:
    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            box.serve(self.request)

    return Handler
