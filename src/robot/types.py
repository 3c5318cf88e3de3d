"""The nouns shared by every part that talks to a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float, Int, UInt8

from see2act.errors import UserError

Split = Literal["seen", "unseen"]
NotNegative = Annotated[float, Ge(0)]
"""A length, time, force or the like in a configuration."""
Cause = Literal["ok", "missed", "collision", "slipped", "no_seal", "wall", "unreachable"]


class RobotError(UserError, ValueError):
    """Something a user asked of the robot that it cannot do; the message names the mend."""


@dataclass(frozen=True)
class Heightmap:
    """The bin seen from straight above. Rows grow towards -y, columns towards +x."""

    color: UInt8[np.ndarray, "H W 3"]
    height: Float[np.ndarray, "H W"]
    """Metres above the bin floor, float32, finite everywhere."""
    valid: Bool[np.ndarray, "H W"]
    """True where the camera really saw a point; elsewhere colour and height were filled in."""


@dataclass(frozen=True)
class Observation:
    """A heightmap and the camera images it was made from."""

    heightmap: Heightmap
    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    """Metres along the optical axis; 0 where the sensor has no reading."""


@dataclass(frozen=True)
class Truth:
    """What only a simulator can say about the scene, on the heightmap's grid. For labels, never for policies."""

    heightmap: Heightmap
    """From noise-free depth."""
    body: Int[np.ndarray, "H W"]
    """Identity of the object seen in each cell, -1 where there is none."""


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
    """World position in metres; z is the surface height at the pixel."""


@dataclass(frozen=True)
class Outcome:
    """What an attempt came to."""

    success: bool
    """As the robot senses it: by pressure (suction) or by finger opening (grasp)."""
    truth: bool
    """Whether an object is really held after the lift, from poses and contacts only."""
    cause: Cause
    reading: float
    """The number that decided ``success``: pressure difference in kPa, or opening in metres."""
    robot_seconds: float
    """How long the motion would take on a real arm at the configured speeds."""
    steps: int
    """Simulation steps taken."""
    lost: int = 0
    """Objects that left the bin without being picked."""
