"""The person at a stand-in's station, for tests and proofs that nobody watches."""

from __future__ import annotations

import re
from time import sleep

from benchmarks.stand_in.cell import PLACES, StandInCell
from see2act.robot.real.operator import Operator


class Person(Operator):
    """Does what is asked, and agrees to everything unless told otherwise.

    Args:
        cell: The station.
    """

    def __init__(self, cell: StandInCell):
        self._cell = cell
        self.asked: list[str] = []
        self.agree = True

    def ask(self, request: str) -> str:
        assert self.asked[-5:] != 5 * [request], f"asked again and again: {request}"
        self.asked.append(request)
        if scene := re.match(r"Scene (\d+): .* of the (seen|unseen) objects", request):
            self._cell.fill(int(scene[1]), "seen" if scene[2] == "seen" else "unseen")
        elif request.startswith("Empty the bin"):
            self._cell.put_board("away")
            self._cell.empty()
        elif request.startswith("Lay the board"):
            self._cell.put_board("floor")
        elif "the board faces the camera" in request:
            self._cell.put_board("tool")
            self._cell.lead("board")
        elif "Lead the arm" in request or request.startswith("Touch the bin's floor"):
            self._cell.lead(next(place for place in PLACES if place in request))
        elif request.startswith("Point"):
            return "{:.1f} {:.1f}".format(*(1000 * metres for metres in self._cell.offset()))
        elif "protective stop" in request:
            self._cell.unlock()
            sleep(0.1)  # until the controller has told it
        return "yes" if self.agree else "no"
