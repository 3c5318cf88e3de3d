"""The person at the station, who fills the bin and clears what the robot must not clear by itself."""

from __future__ import annotations

from abc import ABC, abstractmethod

from see2act.robot.types import RobotError


class Operator(ABC):
    """Somebody who is asked and waited for."""

    @abstractmethod
    def ask(self, request: str) -> str:
        """Say what is to be done, and wait until it is.

        Returns:
            What the person typed, in lower case; empty for Enter alone.
        """

    def agrees(self, question: str) -> bool:
        """Whether the answer is yes. Enter alone is no: what is asked so may move the arm."""
        return self.ask(f"{question} Type yes to agree.") in ("yes", "y")


class Terminal(Operator):
    """A person at the terminal that the program was started from."""

    def ask(self, request: str) -> str:
        """See :class:`Operator`.

        Raises:
            RobotError: Nobody is there.
        """
        try:
            return input(f"\n>> {request}\n>> ").strip().lower()
        except EOFError:
            raise RobotError(
                "a real robot needs a person at the terminal, and nobody answers: start it in a terminal"
            ) from None
