"""The controller's stand-in in a process of its own: ur_rtde's constructors hold Python's lock while they wait for it."""

from __future__ import annotations

import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.stand_in.controller import Controller

TICK = 0.002
"""Seconds between steps of the motion."""


class ControllerProcess:
    """Runs a :class:`Controller` and gives access to it.

    Args:
        speed: How many times faster than real time it moves.
    """

    def __init__(self, speed: float = 10.0):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(speed, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def serve(self, host: str) -> None:
        """Begin anew with a controller in its first state, at another address."""
        self.host = host
        self._ask("serve", host)

    def get(self, name: str) -> Any:
        """A field of the controller's state."""
        return self._ask("get", name)

    def set(self, **values: Any) -> None:
        """Change fields of the controller's state."""
        self._ask("set", values)

    def call(self, method: str) -> Any:
        """Call a method of the controller, or read its property."""
        return self._ask("call", method)

    def log(self) -> list[str]:
        """Commands received so far."""
        found: list[str] = self._ask("log", None)
        return found

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _ask(self, what: str, argument: Any) -> Any:
        self._pipe.send((what, argument))
        return self._pipe.recv()


def _serve(speed: float, pipe: Connection) -> None:
    controller: Controller | None = None
    last = time.monotonic()
    while True:
        now = time.monotonic()
        if controller:
            controller.step((now - last) * speed)
        last = now
        while pipe.poll():
            try:
                what, argument = pipe.recv()
            except EOFError:
                return
            if what == "serve":
                if controller:
                    controller.close()
                controller = Controller(argument)
            pipe.send(_answer(controller, what, argument))
        time.sleep(TICK)


def _answer(controller: Controller | None, what: str, argument: Any) -> Any:
    if what == "get":
        return getattr(controller.state, argument) if controller else None
    if what == "set" and controller:
        for name, value in argument.items():
            setattr(controller.state, name, value)
    if what == "log" and controller:
        return list(controller.log)
    if what == "call":
        found = getattr(controller, argument)
        return found() if callable(found) else found
    return None
