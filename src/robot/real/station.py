"""``station.yaml``: what is known of one lab's arm, tool, camera and bin. The commands write it, people read and edit it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from scipy.spatial.transform import Rotation

from see2act.files import replacing
from see2act.robot.types import RobotError

if TYPE_CHECKING:
    from ruamel.yaml import YAML
    from ruamel.yaml.comments import CommentedMap

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
HEADER = "One lab's arm, tool, camera and bin. Metres, radians, kilograms; poses in the frame of the controller's base."


WRITTEN_BY = {
    "home": "teach",
    "drop": "teach",
    "bin": "teach",
    "calibration": "calibrate",
    "touch": "touch",
    "background": "background",
}
"""The command of `real.py` that writes each part of a station."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


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
    """Metres from the flange to the lowest point of the tool: the closed fingertips, or the cup's rim."""
    mass: NotNegative
    """Kilograms, tool and cables."""
    centre_of_mass: Point = (0.0, 0.0, 0.05)
    """Metres, in the frame of the flange."""
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


class FingersSection(ToolSection):
    """What both kinds of RG2 have.

    Its fingertips move on an arc: closed they are 40 mm lower than open (cranks of 55 mm turn from 18 to 93 degrees). That is
    why ``tip`` is that of the closed ones. At a pick the open fingertips go to ``depth`` below the surface less those 40 mm.
    """

    turn: Finite = 0.0
    """Radians about the flange's axis, from the flange's x axis to the line between the fingertips."""
    opening: Positive = 0.105
    """Metres between the open fingertips."""
    threshold: Positive = 0.01
    """Metres of opening above which an object counts as held."""


class Rg2Modbus(FingersSection, ComputeBoxSection):
    """OnRobot RG2 at a Compute Box."""

    kind: Literal["rg2_modbus"] = "rg2_modbus"
    force: Positive = 20.0
    """Newtons with which it closes, 40 at most."""


class Rg2DigitalOutput(FingersSection):
    """An older RG2 at the tool connector: a digital output closes it, and an analog input of the tool gives the width."""

    kind: Literal["rg2_io"] = "rg2_io"
    output: Annotated[int, Field(ge=0, le=1)] = 0
    """Number of the tool's digital output."""
    volts: tuple[Finite, Finite] = (0.26, 3.0)
    """Volts of the tool's first analog input with the fingertips closed, and open. (The defaults are of OnRobot's script.)"""
    seconds: Positive = 1.0
    """Seconds until the fingers have come to rest."""


class VacuumOutput(ToolSection):
    """A cup at an ejector or pump that a digital output switches, with a pressure sensor or switch."""

    kind: Literal["vacuum_io"] = "vacuum_io"
    output: Channel = 0
    """Number of the digital output of the ejector or pump."""
    blow_off: Channel | None = None
    """Number of the output that blows an object off; null where there is none."""
    analog: Annotated[int, Field(ge=0, le=1)] | None = None
    """Number of the cabinet's analog input with the pressure sensor; null with a vacuum switch."""
    volts: tuple[Finite, Finite] = (1.0, 5.0)
    """Volts of the pressure sensor at ambient pressure, and at full_scale."""
    full_scale: Positive = 100.0
    """Kilopascals below ambient pressure at which the sensor gives its second voltage."""
    digital: Channel | None = None
    """Number of the digital input of a vacuum switch; null with a pressure sensor."""
    seconds: Positive = 0.5
    """Seconds until the pressure has come to rest."""
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
    """Seconds until the pressure has come to rest."""
    threshold: Positive = 20.0
    """Kilopascals below the pressure of the free cup from which on an object counts as held."""


Tool = Annotated[Rg2Modbus | Rg2DigitalOutput | VacuumOutput | Vg10, Field(discriminator="kind")]


class CalibrationSection(_Section):
    """Where the camera is, and how its depth must be corrected. Written by `real.py calibrate`."""

    serial: str
    """Serial number of the camera."""
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
    """Number of views that were used."""
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
    """Serial number of the camera whose calibration was tried."""
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

    def missing(self) -> list[str]:
        """Parts that are not there yet, keys of :data:`WRITTEN_BY`, in the order in which the commands write them."""
        return [part for part in WRITTEN_BY if getattr(self.robot if part in ("home", "drop") else self, part) is None]

    def demand(self, *parts: str) -> None:
        """Refuse a station that lacks one of these parts, keys of :data:`WRITTEN_BY`.

        Raises:
            RobotError: With the command that writes the first that is missing.
        """
        for part in self.missing():
            if part in parts:
                raise RobotError(f"the station has no {part}: type `python real.py {WRITTEN_BY[part]}`")

    def demand_camera(self, serial: str) -> None:
        """Refuse a camera that the station was not calibrated with.

        Raises:
            RobotError: With both serial numbers.
        """
        self.demand("calibration")
        if self.calibration and serial != self.calibration.serial:
            raise RobotError(
                f"the camera is {serial}, and the station was calibrated with {self.calibration.serial}: connect that one, or "
                "type `python real.py calibrate`"
            )

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
        self.demand("bin")
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
    yaml = _yaml(typ="safe", pure=True)
    from ruamel.yaml import YAMLError

    try:
        content = yaml.load(path)
    except (YAMLError, ValueError, RecursionError) as error:
        raise RobotError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    try:
        return Station.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RobotError(f"{path}: {place}: {first['msg']} (found {_short(first['input'])})") from None


def save(station: Station, path: Path) -> None:
    """Write a station atomically. What a person wrote beside the values of an existing file stays."""
    yaml = _yaml()
    from ruamel.yaml.comments import CommentedMap

    yaml.width = 128
    yaml.representer.add_representer(type(None), lambda dumper, _: dumper.represent_scalar("tag:yaml.org,2002:null", "null"))
    document = yaml.load(path) if path.is_file() else CommentedMap()
    if not document:
        document.yaml_set_start_comment(HEADER)
    _update(document, station)
    with replacing(path) as partial:
        yaml.dump(document, partial)


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


def _yaml(**options: Any) -> YAML:
    """The package that keeps comments. It is imported late, since only stations need it.

    Raises:
        RobotError: It is not installed.
    """
    try:
        from ruamel.yaml import YAML
    except ImportError:
        raise RobotError("a station needs the package ruamel.yaml: pip install 'see2act[real]'") from None
    return YAML(**options)


def _update(document: CommentedMap, section: BaseModel, depth: int = 0) -> None:
    """Bring a mapping of YAML up to a section's values. New keys get the section's description as a comment."""
    from ruamel.yaml.comments import CommentedMap

    fields = type(section).model_fields
    for name in sorted(fields, key=lambda name: name != "kind"):  # a tool's kind first
        value, description, new = getattr(section, name), fields[name].description, name not in document
        if isinstance(value, BaseModel):
            if not isinstance(document.get(name), CommentedMap):
                document[name] = CommentedMap()
            _update(document[name], value, depth + 1)
        else:
            document[name] = _as_yaml(value)
        if new and description:
            document.yaml_set_comment_before_after_key(name, fill(" ".join(description.split()), 110), 2 * depth)


def _as_yaml(value: Any) -> Any:
    """A value with lists of numbers on one line, so that a pose reads as one."""
    from ruamel.yaml.comments import CommentedSeq

    if not isinstance(value, tuple):
        return value
    items = CommentedSeq(_as_yaml(item) for item in value)
    if not any(isinstance(item, tuple) for item in value):
        items.fa.set_flow_style()
    return items
