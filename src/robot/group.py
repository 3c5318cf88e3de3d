"""Several robots that act at the same time, each in a separate process."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from see2act.robot.robot import Robot
from see2act.robot.types import RobotError


class RobotGroup:
    """Robots, numbered from 0. A single robot runs in this process; several robots run in one process each.

    Args:
        make: Builds a robot. It runs in worker processes, so it must be picklable.
        count: Number of robots.
    """

    def __init__(self, make: Callable[[], Robot], count: int):
        self._alone = make() if count == 1 else None
        self._workers = [_Worker(make) for _ in range(count)] if count > 1 else []

    @property
    def attended(self) -> bool:
        """Whether a person fills the bin; see :class:`Robot`. Such a robot is alone."""
        return self._alone is not None and self._alone.attended

    def __len__(self) -> int:
        return len(self._workers) or 1

    def call(self, method: str, arguments: Mapping[int, tuple]) -> dict[int, Any]:
        """Call a method of some robots, in parallel.

        Args:
            method: Name of the method.
            arguments: Arguments of the call, by robot.

        Returns:
            The return values, by robot, in the order of ``arguments``.

        Raises:
            RobotError: A robot raised it, or the process of a robot has ended.
        """
        if self._alone is not None:
            return {i: getattr(self._alone, method)(*given) for i, given in arguments.items()}
        for i, given in arguments.items():
            self._workers[i].ask(method, given)
        # Read all answers before raising an error. An answer left in a pipe would be taken for that of the next call.
        answers = {i: self._workers[i].answer() for i in arguments}
        for answer in answers.values():
            if isinstance(answer, RobotError):
                raise answer
        return answers

    def close(self) -> None:
        """Close all robots. Safe to call twice."""
        if self._alone is not None:
            self._alone.close()
        for worker in self._workers:
            worker.close()


class _Worker:
    """A robot in a separate process, which ends when this process ends."""

    def __init__(self, make: Callable[[], Robot]):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(make, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, method: str, given: tuple) -> None:
        with suppress(OSError):  # the process has ended; answer() reports it
            self._pipe.send((method, given))

    def answer(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            return RobotError("the process of a robot has ended: type the same command again, and the run goes on")

    def close(self) -> None:
        self._pipe.close()
        self._process.join(timeout=5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(make: Callable[[], Robot], pipe: Connection) -> None:
    """Answer calls until the other end of the pipe is closed or its process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C and then closes the pipe
    robot = make()
    try:
        while True:
            method, given = pipe.recv()
            try:
                pipe.send(getattr(robot, method)(*given))
            except RobotError as error:
                pipe.send(error)
    except (EOFError, OSError):
        pass
    finally:
        robot.close()
