"""What every end effector promises; suction cup and gripper are its two kinds."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from abc import ABC, abstractmethod

import numpy as np
from see2act.robot.arm import Arm
from see2act.robot.simulation import Simulation
from see2act.robot.types import Cause


class EndEffector(ABC):
    """A tool on the arm: how it approaches a pick, holds, and senses what it holds."""

    primitive: str
    """The motion primitive it executes."""
    contact_limit: float
    """Newtons on the tool at which a descent stops."""
    half_opening: float = 0.0
    """Metres from its middle to each jaw while they are open; 0 where it has none."""

    @abstractmethod
    def urdf(self) -> ET.Element:
        """Its links and joints; the first link is fixed to the arm's ``tool0``."""

    @abstractmethod
    def bind(self, simulation: Simulation, arm: Arm) -> None:
        """Find its joints in the freshly loaded arm and make them ready."""

    @abstractmethod
    def length(self) -> float:
        """Metres from ``tool0`` to the point that meets the pick."""

    @abstractmethod
    def depth_at(self, surface: np.ndarray) -> np.ndarray:
        """World z in metres where that point goes for surface heights: deeper by the configured depth, never into the floor."""

    @abstractmethod
    def prepare(self) -> None:
        """Before the descent: open, or start the pump."""

    @abstractmethod
    def engage(self) -> None:
        """At the pick: close, or seal."""

    @abstractmethod
    def engaged(self) -> bool:
        """Whether it took hold of something when it engaged (for the cause of a failure, never for the verdict)."""

    @abstractmethod
    def why_failed(self, engaged: bool, blocked: bool) -> Cause:
        """The cause of a failure on an object.

        Args:
            engaged: Whether it had hold of something.
            blocked: Whether the descent was stopped by force.
        """

    @abstractmethod
    def update_hold(self) -> None:
        """Called after every step of the lift: let go where the load is more than the hold can bear."""

    @abstractmethod
    def sense(self) -> tuple[float, bool]:
        """The reading and the verdict drawn from it."""

    @abstractmethod
    def release(self) -> None:
        """Let go."""
