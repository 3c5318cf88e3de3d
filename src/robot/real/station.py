"""``station.yaml``: what is known of one lab's arm, tool, camera and bin. The commands write it, people read and edit it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from scipy.spatial.transform import Rotation

from see2act.files import replacing
from see2act.robot.types import RobotError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite, Finite]
"""x, y, z in metres, in the frame of the controller's base."""
Pose = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
"""x, y, z in metres and a rotation vector in radians, as the controller writes poses."""
Joints = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
"""Radians, from the base to the last wrist."""
Channel = Annotated[int, Field(ge=0, le=7)]
"""Number of a digital output or input in the controller's cabinet."""
HEADER = "# One lab's arm, tool, camera and bin. Metres, radians, kilograms; poses in the frame of the controller's base.\n"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RobotSection(_Section):
    """The arm."""

    host: str
    """Address of the controller."""
    home: Joints | None = None
    """Where the arm waits, out of the camera's view. Written by `real.py teach`."""
    drop: Joints | None = None
    """Where it lets go of an object that was picked. Written by `real.py teach`."""


class ToolSection(_Section):
    """What every tool has."""

    tip: Positive
    """Metres from the flange to the lowest point of the open tool: the fingertips, or the cup's rim."""
    mass: NotNegative
    """Kilograms, tool and cables."""
    centre_of_mass: Point = (0.0, 0.0, 0.05)
    """In the frame of the flange."""
    depth: NotNegative
    """Metres below the surface at a pick to which the tip goes."""
    floor_gap: NotNegative = 0.003
    """Metres above the bin's floor below which the tip never goes."""


class ComputeBoxSection(ToolSection):
    """A tool at OnRobot's Compute Box."""

    host: str
    """Address of the Compute Box."""
    port: int = 502
    unit: int = 65
    """Modbus unit of the tool: 65 at the first connector."""


class Rg2Modbus(ComputeBoxSection):
    """OnRobot RG2 at a Compute Box."""

    kind: Literal["rg2_modbus"] = "rg2_modbus"
    opening: Positive = 0.105
    """Metres between the open fingertips."""
    force: Positive = 20.0
    """Newtons, 40 at most."""
    threshold: Positive = 0.01
    """Metres of opening above which an object counts as held."""


class Rg2DigitalOutput(ToolSection):
    """An older RG2 at the tool connector: a digital output closes it, and an analog input of the tool gives the width."""

    kind: Literal["rg2_io"] = "rg2_io"
    output: Annotated[int, Field(ge=0, le=1)] = 0
    """Number of the tool's digital output."""
    opening: Positive = 0.105
    """Metres between the open fingertips."""
    volts: tuple[Finite, Finite] = (0.26, 3.0)
    """Of the tool's first analog input with the fingertips closed, and open; the defaults are those of OnRobot's script."""
    seconds: Positive = 1.0
    """Until the fingers have come to rest."""
    threshold: Positive = 0.01
    """Metres of opening above which an object counts as held."""


class VacuumOutput(ToolSection):
    """A cup at an ejector or pump that a digital output switches, with a pressure sensor or switch."""

    kind: Literal["vacuum_io"] = "vacuum_io"
    output: Channel = 0
    """Of the ejector."""
    blow_off: Channel | None = None
    """Output that blows an object off; None where there is none."""
    analog: Annotated[int, Field(ge=0, le=1)] | None = None
    """Number of the cabinet's analog input with the pressure sensor; None for a switch at ``digital``."""
    volts: tuple[Finite, Finite] = (1.0, 5.0)
    """Of the sensor at ambient pressure, and at ``full_scale``."""
    full_scale: Positive = 100.0
    """Kilopascals below ambient."""
    digital: Channel | None = None
    """Digital input of a vacuum switch; None with an analog sensor."""
    seconds: Positive = 0.5
    """Until the pressure has come to rest."""
    threshold: Positive = 20.0
    """Kilopascals below the pressure of the free cup from which on an object counts as held."""


class Vg10(ComputeBoxSection):
    """OnRobot VG10 at a Compute Box."""

    kind: Literal["vg10"] = "vg10"
    channel: Literal["a", "b", "both"] = "both"
    """Of the two air channels, the one with cups."""
    vacuum: Annotated[float, Field(gt=0, le=80)] = 40.0
    """Percent of a full vacuum, 80 at most."""
    seconds: Positive = 0.5
    """Until the pressure has come to rest."""
    threshold: Positive = 20.0
    """Kilopascals below the pressure of the free cup from which on an object counts as held."""


Tool = Annotated[Rg2Modbus | Rg2DigitalOutput | VacuumOutput | Vg10, Field(discriminator="kind")]


class CalibrationSection(_Section):
    """Where the camera is, and how its depth must be corrected. Written by `real.py calibrate`."""

    serial: str
    """Of the camera."""
    size: tuple[int, int]
    """Columns and rows of its images."""
    camera: tuple[tuple[Finite, Finite, Finite, Finite], ...]
    """Camera to the controller's base, 4 by 4, metres; in the camera's frame x is right, y down and z forward."""
    depth_scale: Positive = 1.0
    depth_offset: Finite = 0.0
    """Metres. True depth is scale times the camera's depth plus offset."""
    error: NotNegative
    """Metres, rms, of points on the bin's floor, as estimated from poses that were left out."""
    views: int
    """How many were used."""
    date: str

    @field_validator("camera")
    @classmethod
    def _is_rigid(cls, rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        matrix = np.array(rows)
        if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise ValueError("must be 4 by 4 with a last row of 0 0 0 1")
        if not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4) or np.linalg.det(matrix[:3, :3]) < 0:
            raise ValueError("must be a rotation and a translation")
        return rows


class TouchSection(_Section):
    """Result of `real.py touch`."""

    offset: NotNegative
    """Metres between where the tool went and where a person saw it arrive, the largest."""
    serial: str
    """Of the camera whose calibration was tried."""
    date: str


class Station(_Section):
    """One lab."""

    robot: RobotSection
    tool: Tool
    bin: tuple[Point, Point, Point] | None = None
    """Corners of the bin's floor in the frame of the controller's base, as seen from the robot: near left, near right, far
    left. Written by `real.py teach`."""
    calibration: CalibrationSection | None = None
    touch: TouchSection | None = None
    background: str | None = None
    """File with images of the empty bin, beside this file. Written by `real.py background`."""

    @property
    def primitive(self) -> str:
        """What the tool can do."""
        return "grasp" if self.tool.kind in ("rg2_modbus", "rg2_io") else "suction"

    @property
    def trusted(self) -> bool:
        """Whether a touch test of this calibration was clean; until then the arm is slow."""
        return bool(
            self.touch and self.calibration and self.touch.serial == self.calibration.serial and self.touch.offset <= CLEAN
        )

    def world(self) -> Float[np.ndarray, "4 4"]:
        """World to the controller's base. The world's origin is in the middle of the bin's floor, x points away from the
        robot along the bin's sides, and z up out of the bin.

        Raises:
            RobotError: The bin is not taught yet, or its corners are not those of a rectangle.
        """
        if self.bin is None:
            raise RobotError("the station has no bin: type `python real.py teach`")
        near_left, near_right, far_left = np.array(self.bin)
        across, along = near_left - near_right, far_left - near_left
        width, length = np.linalg.norm(along), np.linalg.norm(across)
        if min(width, length) < 0.05 or abs(across @ along) > 0.03 * width * length:
            raise RobotError(
                "the three corners of the bin in the station are not those of a rectangle: teach them again, near left, near "
                "right, far left as seen from the robot"
            )
        x = along / width
        z = np.cross(x, across / length)
        z /= np.linalg.norm(z)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        pose[:3, 3] = (near_right + far_left) / 2
        return pose

    def bin_size(self) -> tuple[float, float]:
        """Extent of the bin's floor along the world's x and y, metres.

        Raises:
            RobotError: The bin is not taught yet.
        """
        self.world()
        near_left, near_right, far_left = np.array(self.bin)
        return float(np.linalg.norm(far_left - near_left)), float(np.linalg.norm(near_left - near_right))


CLEAN = 0.003
"""Metres: the largest offset of a clean touch test."""


def load(path: Path) -> Station:
    """Read a station.

    Raises:
        RobotError: It is not there, or it is no station; the line names the key.
    """
    if not path.is_file():
        raise RobotError(f"there is no station at {path}: type `python real.py new` to write one, or give robot.station=FILE")
    try:
        return Station.model_validate(yaml.safe_load(path.read_text()))
    except yaml.YAMLError as error:
        raise RobotError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RobotError(f"{path}: {place}: {first['msg']} (found {_short(first['input'])})") from None


def save(station: Station, path: Path) -> None:
    """Write a station atomically. Comments that a person wrote into the file are lost; values are not."""
    data = station.model_dump(mode="json", exclude_none=True)
    with replacing(path) as partial:
        partial.write_text(HEADER + yaml.dump(data, Dumper=_FlatLists, sort_keys=False, width=128))


def matrix(pose: Sequence[float] | np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Pose of the controller as a matrix."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    result[:3, 3] = pose[:3]
    return result


def pose(matrix: Float[np.ndarray, "4 4"]) -> Pose:
    """Matrix as a pose of the controller."""
    values = (*matrix[:3, 3], *Rotation.from_matrix(matrix[:3, :3]).as_rotvec())
    return tuple(float(value) for value in values)  # type: ignore[return-value]


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


class _FlatLists(yaml.SafeDumper):
    """Lists of numbers on one line, so that a pose reads as one."""


def _list(dumper: yaml.SafeDumper, data: list) -> yaml.Node:
    flat = all(not isinstance(item, list | dict) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_FlatLists.add_representer(list, _list)
