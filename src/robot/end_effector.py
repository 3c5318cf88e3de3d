"""The interface of end effectors. The suction cup and the gripper implement it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from abc import ABC, abstractmethod

import numpy as np

from see2act.robot.arm import Arm
from see2act.robot.simulation import Simulation
from see2act.robot.types import Cause


class EndEffector(ABC):
    """A tool on the arm: how it approaches a pick, holds an object, and senses the hold."""

    primitive: str
    """The motion primitive that it executes."""
    contact_limit: float
    """Contact force at which a descent stops, newtons."""
    half_opening: float = 0.0
    """Metres from the middle to each open jaw; 0 for a tool without jaws."""

    @abstractmethod
    def urdf(self) -> ET.Element:
        """The tool's links and joints. The first link is fixed to the arm's ``tool0``."""

    @abstractmethod
    def bind(self, simulation: Simulation, arm: Arm) -> None:
        """Find and configure the tool's joints in an arm that was just loaded."""

    @abstractmethod
    def length(self) -> float:
        """Metres from ``tool0`` to the point of the tool that goes to the pick."""

    @abstractmethod
    def depth_at(self, surface: np.ndarray) -> np.ndarray:
        """World z in metres to which that point goes for given surface heights.

        It is lower than the surface by the configured depth, but never in the floor.
        """

    @abstractmethod
    def prepare(self) -> None:
        """Open, or start the pump. Called before the descent."""

    @abstractmethod
    def engage(self) -> None:
        """Close, or seal. Called at the pick."""

    @abstractmethod
    def engaged(self) -> bool:
        """Whether the tool took hold of something. Used for the cause of a failure, never for the verdict."""

    @abstractmethod
    def why_failed(self, engaged: bool, blocked: bool) -> Cause:
        """The cause of a failed pick that touched an object.

        Args:
            engaged: Whether the tool took hold of something.
            blocked: Whether force stopped the descent.
        """

    @abstractmethod
    def update_hold(self) -> None:
        """Let go if the load is more than the hold can bear. Called after every step of the lift."""

    @abstractmethod
    def sense(self) -> tuple[float, bool]:
        """The sensor reading, and whether it means success."""

    @abstractmethod
    def release(self) -> None:
        """Let go."""
