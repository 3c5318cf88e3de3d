"""Several robots that act at the same time, each in a process of its own."""

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
    """Robots by number, from 0. One robot lives in this process; several live in one each.

    Args:
        make: Builds a robot; runs in worker processes, so it must pickle.
        count: How many.
    """

    def __init__(self, make: Callable[[], Robot], count: int):
        self._alone = make() if count == 1 else None
        self._workers = [_Worker(make) for _ in range(count)] if count > 1 else []

    def __len__(self) -> int:
        return len(self._workers) or 1

    def call(self, method: str, arguments: Mapping[int, tuple]) -> dict[int, Any]:
        """Call a method of some robots, all at once.

        Args:
            method: Its name.
            arguments: Those of the call, by robot.

        Returns:
            What each returned, by robot, in the order of ``arguments``.

        Raises:
            RobotError: A robot raised it, or its process has ended.
        """
        if self._alone is not None:
            return {i: getattr(self._alone, method)(*given) for i, given in arguments.items()}
        for i, given in arguments.items():
            self._workers[i].ask(method, given)
        # All answers are taken before the first error is raised: what is left in a pipe would answer the next question.
        answers = {i: self._workers[i].answer() for i in arguments}
        for answer in answers.values():
            if isinstance(answer, RobotError):
                raise answer
        return answers

    def close(self) -> None:
        """Give all of them back; safe to call twice."""
        if self._alone is not None:
            self._alone.close()
        for worker in self._workers:
            worker.close()


class _Worker:
    """A robot in a process of its own, which ends with this one."""

    def __init__(self, make: Callable[[], Robot]):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(make, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, method: str, given: tuple) -> None:
        with suppress(OSError):  # the process has ended; answer() says so
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
    """Answer until the other end is closed, or its process is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then closes the pipe
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
