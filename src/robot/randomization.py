"""What differs between a simulated camera and a real one, drawn anew for every scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float

from see2act.robot.types import NotNegative, RobotError


@dataclass(frozen=True)
class Light:
    """Light from one side and from all around, in the terms of PyBullet's TinyRenderer. The defaults are the renderer's own.

    Args:
        direction: World direction to the lamp, of any length.
        color: Red, green and blue of the lamp; ambient light is white.
        ambient: Brightness of a white face that the lamp does not reach.
        diffuse: What the lamp adds on a face that points at it.
    """

    direction: tuple[float, float, float] = (-50.0, 30.0, 100.0)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ambient: NotNegative = 0.6
    diffuse: NotNegative = 0.35


@dataclass(frozen=True)
class Disturbance:
    """What is drawn for one scene."""

    position: Float[np.ndarray, "3"]
    """Metres by which the camera is elsewhere, along the world's axes."""
    rotation: Float[np.ndarray, "3"]
    """Rotation vector in radians by which it is turned about itself, in the world's frame."""
    depth_scale: float
    """The sensor's depth as a share of the true one."""
    sigma: float
    edge_rate: float
    grazing_rate: float
    """Factors on the sensor's noise."""
    light: Light


@dataclass(frozen=True)
class Randomization:
    """Ranges of what is drawn for each scene. docs/sim_to_real.md says where the numbers come from.

    Together, position, rotation and depth scale put points in the bin 1.9 mm (rms) from where they are, and in one scene of
    thirty more than 3 mm, from which on a calibration of a real camera is refused. It is usually off by 0.3 to 0.6 mm.

    Args:
        position: Largest error of the camera's position along each axis, metres.
        rotation: Largest error of its rotation about each axis, radians.
        depth_scale: Largest error of its depth, as a share.
        noise: Largest factor by which the disparity's error is multiplied or divided.
        holes: The same for the rates at which edges and grazing angles lose their reading; a rate stays at most 1.
        tilt: Largest angle between the direction to the lamp and the vertical, radians.
        ambient: Least and most ambient light, as in :class:`Light`.
        diffuse: The same for the lamp.
        color: Largest difference of each of the lamp's channels from 1.

    Raises:
        RobotError: A range of light is not two numbers, of which the first is the smaller.
    """

    position: Annotated[float, Ge(0), Le(0.05)] = 0.0015
    rotation: Annotated[float, Ge(0), Le(0.1)] = 0.0015
    depth_scale: Annotated[float, Ge(0), Le(0.1)] = 0.0015
    noise: Annotated[float, Ge(1)] = 1.5
    holes: Annotated[float, Ge(1)] = 1.5
    tilt: Annotated[float, Ge(0), Le(np.pi / 2)] = 1.0
    ambient: tuple[float, float] = (0.45, 0.8)
    diffuse: tuple[float, float] = (0.2, 0.6)
    color: Annotated[float, Ge(0), Le(1)] = 0.3

    def __post_init__(self) -> None:
        for name in ("ambient", "diffuse"):
            limits = getattr(self, name)
            try:
                low, high = limits
                fits = 0 <= low <= high
            except (TypeError, ValueError):
                fits = False
            if not fits:
                raise RobotError(f"camera.randomization.{name}={limits} is no range: give [least,most], from 0 on")

    def draw(self, rng: np.random.Generator) -> Disturbance:
        """What one scene has."""
        return Disturbance(
            position=rng.uniform(-self.position, self.position, 3),
            rotation=rng.uniform(-self.rotation, self.rotation, 3),
            depth_scale=1 + rng.uniform(-self.depth_scale, self.depth_scale),
            sigma=_factor(rng, self.noise),
            edge_rate=_factor(rng, self.holes),
            grazing_rate=_factor(rng, self.holes),
            light=self._light(rng),
        )

    def parallax(self, distance: float) -> float:
        """Radians by which a point is seen elsewhere at most, from a distance in metres."""
        return float(np.sqrt(3) * (self.rotation + self.position / distance))

    def _light(self, rng: np.random.Generator) -> Light:
        down, around = rng.uniform(np.cos(self.tilt), 1), rng.uniform(0, 2 * np.pi)
        across = np.sqrt(1 - down**2)
        red, green, blue = rng.uniform(1 - self.color, 1 + self.color, 3).tolist()
        return Light(
            direction=(float(across * np.cos(around)), float(across * np.sin(around)), float(down)),
            color=(red, green, blue),
            ambient=rng.uniform(*self.ambient),
            diffuse=rng.uniform(*self.diffuse),
        )


def _factor(rng: np.random.Generator, most: float) -> float:
    """Between 1 / ``most`` and ``most``, either side as often."""
    return float(most ** rng.uniform(-1, 1))
