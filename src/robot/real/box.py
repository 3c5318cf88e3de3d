"""The space above the bin that the tool's tip must not leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from see2act.robot.real.station import Station

CEILING = 0.45
"""Metres above the bin's floor."""
DEEPEST = 0.004
"""Metres below the taught floor that are still allowed: what teaching by hand and calibration may be off."""


@dataclass(frozen=True)
class Box:
    """A box in the frame of the bin.

    Args:
        world: World to the controller's base; see :meth:`Station.world`.
        low, high: Opposite corners in the world, metres.
    """

    world: Float[np.ndarray, "4 4"]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    @classmethod
    def above(cls, station: Station) -> Box:
        """All above the floor of a station's bin, up to :data:`CEILING`.

        Raises:
            RobotError: The bin is not taught.
        """
        width, length = station.bin_size()
        corner = np.array([width / 2, length / 2, 0.0])
        return cls(station.world(), -corner - [0, 0, DEEPEST], corner + [0, 0, CEILING])

    def objection(self, point: Float[np.ndarray, "3"]) -> str | None:
        """Where a point in the controller's base lies outside; None where it does not."""
        at = self.world[:3, :3].T @ (point - self.world[:3, 3])
        for axis, (value, low, high) in enumerate(zip(at, self.low, self.high, strict=True)):
            if not low <= value <= high:
                beyond = max(low - value, value - high)
                side = (("the near side", "the far side"), ("the right side", "the left side"), ("the floor", "the ceiling"))
                return f"{1000 * beyond:.0f} mm beyond {side[axis][int(value > high)]} of the taught bin"
        return None
