"""`real.py new`: a station's file with what must be known before anything can be connected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from see2act.robot.real import station as stations
from see2act.robot.real.station import Rg2DigitalOutput, Rg2Modbus, RobotSection, Station, VacuumOutput, Vg10
from see2act.robot.types import RobotError

TOOLS: dict[str, type[Rg2Modbus | Rg2DigitalOutput | VacuumOutput | Vg10]] = {
    "rg2_modbus": Rg2Modbus,
    "rg2_io": Rg2DigitalOutput,
    "vacuum_io": VacuumOutput,
    "vg10": Vg10,
}
MASS = {"rg2_modbus": 0.78, "rg2_io": 0.78, "vacuum_io": 0.3, "vg10": 1.62}
"""Kilograms: of OnRobot's tools from their data sheets, of a plain cup with its tubes our estimate."""
DEPTH = {"rg2_modbus": 0.05, "rg2_io": 0.05, "vacuum_io": 0.004, "vg10": 0.004}
"""Metres below the surface to which the tip goes. A cup's lip is pressed on the surface. The open fingertips of an RG2 go 1 cm
below it: they are 4 cm higher than the closed ones."""


def new(path: Path, host: str, tool: str, tip: float, tool_host: str | None = None, mass: float | None = None) -> Station:
    """Write a station without taught places.

    Args:
        path: Of the file.
        host: Address of the arm's controller.
        tool: A key of :data:`TOOLS`.
        tip: Metres from the flange to the lowest point of the tool, its fingers closed.
        tool_host: Address of OnRobot's Compute Box, for the tools that have one.
        mass: Kilograms, tool and cables; None for a data sheet's.

    Raises:
        RobotError: There is a file already, or a value is impossible.
    """
    if path.exists():
        raise RobotError(f"{path} is there already: edit it, or give another one with --station")
    needs_host = "host" in TOOLS[tool].model_fields
    if needs_host != (tool_host is not None):
        raise RobotError(
            f"--tool {tool} is at OnRobot's Compute Box: give its address with --tool-host"
            if needs_host
            else f"--tool {tool} has no address of its own: leave out --tool-host"
        )
    values: dict[str, Any] = {"tip": tip, "mass": MASS[tool] if mass is None else mass, "depth": DEPTH[tool]}
    values |= {"host": tool_host} if needs_host else {}
    if tool == "vacuum_io":
        values["analog"] = 0
    try:
        made = Station(robot=RobotSection(host=host), tool=TOOLS[tool](**values))
    except ValidationError as error:
        first = error.errors()[0]
        raise RobotError(f"{'.'.join(map(str, first['loc']))}={first['input']}: {first['msg']}") from None
    stations.save(made, path)
    return made
