"""The interface between learning and a robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np

from see2act.robot.types import Heightmap, Observation, Outcome, Pick, Split, Truth
from see2act.robot.workspace import Workspace


class Robot(ABC):
    """What learning asks of a robot. To add another one, subclass this and implement the abstract methods."""

    workspace: Workspace
    primitive: str
    half_opening: float = 0.0
    """Metres from a pick to each open jaw, along the pick's angle; 0 for a tool without jaws. Used in figures only."""
    repeatable: bool = False
    """Whether the same picks in a scene of the same seed always have the same outcomes, so that test runs can be reused."""
    attended: bool = False
    """Whether a person fills the bin, so that nothing that happened can be made again: a real robot."""

    @abstractmethod
    def reset(self, scene_seed: int, split: Split, count: int | None = None) -> None:
        """Empty the bin and fill it with a new scene. ``scene_seed`` determines the scene and its sensor noise.

        Args:
            scene_seed: Seed of the scene.
            split: Which objects to use.
            count: Put in only this many of the scene's objects; None for all of them.

        Raises:
            RobotError: No valid scene could be made.
        """

    def resume(self, scene_seed: int, attempts: int) -> bool:
        """Whether the bin is as an interrupted run left it in this scene after some attempts; if not, a new scene begins.

        Only an attended robot is asked: with another one the attempts are made again.
        """
        return False

    @abstractmethod
    def background(self) -> Heightmap:
        """Heightmap of the empty bin. It clears the scene, so call it before :meth:`reset`."""

    @abstractmethod
    def observe(self) -> Observation:
        """Take an image of the bin while the arm is at home.

        Raises:
            RobotError: Nothing of the workspace is in view.
        """

    @abstractmethod
    def execute(self, pick: Pick) -> Outcome:
        """Execute the motion primitive open loop, remove an object that is held, and return home."""

    @abstractmethod
    def bin_empty(self) -> bool:
        """Whether nothing is left to pick."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources."""

    def truth(self) -> Truth:
        """What is really in the bin, for labels. By default this is what the robot senses; then use ``labels=vision``."""
        heightmap = self.observe().heightmap
        return Truth(heightmap, np.full(heightmap.height.shape, -1))

    def film(self, path: Path) -> AbstractContextManager[None]:
        """Record what happens in the block as an MP4 at ``path``, if the robot supports it. The default records nothing."""
        return nullcontext()
