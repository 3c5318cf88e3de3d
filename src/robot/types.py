"""Types shared by all code that uses a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from see2act.errors import UserError

Split = Literal["seen", "unseen"]
NotNegative = Annotated[float, Ge(0)]
"""A length, time, force or similar quantity in the configuration."""
Positive = Annotated[float, Gt(0)]
"""The same, where 0 has no meaning."""
Limit = Annotated[float, Field(ge=0, allow_inf_nan=True)]
"""A limit in the configuration; infinite where there is none."""
Cause = Literal["ok", "missed", "collision", "slipped", "no_seal", "wall", "unreachable", "protective_stop", "dry_run"]
"""Why an attempt failed, or ``ok``. The last two are of a real robot only."""
ABORTED: tuple[Cause, ...] = ("protective_stop", "dry_run")
"""Causes of attempts that were not carried through and say nothing of the pick."""


class RobotError(UserError, ValueError):
    """The robot cannot do what the user asked for. The message says how to fix it."""


def is_triple(value: object) -> bool:
    """Whether something from a configuration is three finite numbers, such as a position."""
    try:
        numbers = np.asarray(value)
    except ValueError:  # lists of different lengths
        return False
    return numbers.shape == (3,) and numbers.dtype.kind in "iuf" and bool(np.isfinite(numbers).all())


@dataclass(frozen=True)
class Heightmap:
    """The bin seen from straight above. Rows grow towards -y, columns towards +x."""

    color: UInt8[np.ndarray, "H W 3"]
    height: Float[np.ndarray, "H W"]
    """Metres above the bin's floor, float32, finite everywhere."""
    valid: Bool[np.ndarray, "H W"]
    """True where the camera saw a point. Elsewhere colour and height are filled in."""


@dataclass(frozen=True)
class Observation:
    """A heightmap and the camera images that it was made from."""

    heightmap: Heightmap
    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    """Metres along the optical axis; 0 where the sensor has no reading."""


@dataclass(frozen=True)
class Truth:
    """What only a simulator knows about the scene, on the heightmap's grid. Used for labels, never by policies."""

    heightmap: Heightmap
    """A heightmap from noise-free depth."""
    body: Int[np.ndarray, "H W"]
    """Id of the object seen in each cell; -1 if there is none."""


@dataclass(frozen=True)
class Pick:
    """One execution of a motion primitive."""

    row: int
    col: int
    angle: float
    """Radians, counter-clockwise seen from above; at 0 the jaws close along x."""
    x: float
    y: float
    z: float
    """World position (x, y, z) in metres; z is the surface height at the pixel."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of an attempt."""

    success: bool
    """Success as the robot senses it: by pressure (suction) or by finger opening (grasp)."""
    truth: bool | None
    """Whether an object is really held after the lift, judged only by poses and contacts; None where nobody can know."""
    cause: Cause
    reading: float
    """The sensor reading that decided ``success``: pressure difference in kPa, or opening in metres."""
    robot_seconds: float
    """Time that the motion would take on a real arm at the configured speeds."""
    steps: int
    """Number of simulation steps."""
    lost: int = 0
    """Number of objects that left the bin without being picked."""

    @property
    def aborted(self) -> bool:
        """Whether it was not carried through. Nothing is learned from it."""
        return self.cause in ABORTED
