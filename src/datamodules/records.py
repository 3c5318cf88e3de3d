"""Attempts of a real robot, each in a file of its own from the moment it happened: they cannot be made again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from see2act.attempt import Attempt
from see2act.files import read_arrays, write_arrays
from see2act.policy import Choice
from see2act.robot.types import Heightmap, Observation, Outcome, Pick

IMAGES = ("color", "depth")
MAPS = ("color", "height", "valid")


@dataclass(frozen=True)
class Records:
    """A folder with an attempt a file. A record says what was seen, chosen and done, and what came of it.

    Args:
        folder: Made with the first attempt.
    """

    folder: Path

    def save(self, name: str, attempt: Attempt) -> None:
        """Write an attempt, atomically.

        Args:
            name: Of the file, without its ending.
            attempt: It.
        """
        observation = attempt.observation
        arrays = {f"image_{key}": getattr(observation, key) for key in IMAGES}
        arrays |= {f"map_{key}": getattr(observation.heightmap, key) for key in MAPS}
        facts: dict[str, object] = {
            "choice": asdict(attempt.choice),
            "pick": asdict(attempt.pick),
            "outcome": asdict(attempt.outcome),
        }
        facts["seconds"] = [attempt.t_observe, attempt.t_decide, attempt.t_act]
        write_arrays(self._path(name), {"facts": np.array(json.dumps(facts)), **arrays})

    def save_aborted(self, step: int, attempt: Attempt) -> None:
        """Write an attempt that was not carried through, in place of the training attempt of a number."""
        tries = len(list(self.folder.glob(f"aborted-{step:05}-*.npz")))
        self.save(f"aborted-{step:05}-{tries + 1}", attempt)

    def load(self, name: str) -> Attempt | None:
        """The attempt of that name; None if there is none."""
        return self.read(name) if self._path(name).exists() else None

    def read(self, name: str) -> Attempt:
        """The same.

        Raises:
            DamagedFile: It is no record.
            FileNotFoundError: There is none.
        """
        maps, images = [f"map_{key}" for key in MAPS], [f"image_{key}" for key in IMAGES]
        arrays = read_arrays(self._path(name), ("facts", *maps, *images))
        facts = json.loads(str(arrays["facts"]))
        heightmap = Heightmap(*(arrays[key] for key in maps))
        observation = Observation(heightmap, *(arrays[key] for key in images))
        return Attempt(
            observation, Choice(**facts["choice"]), Pick(**facts["pick"]), Outcome(**facts["outcome"]), *facts["seconds"]
        )

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def training(step: int) -> str:
    """Name of the training attempt of a number, from 1."""
    return f"finetune-{step:05}"


def testing(phase: str, step: int, policy: str, number: int) -> str:
    """Name of an attempt of an evaluation, numbered from 1 in each."""
    return f"{phase}-{step:05}-{policy}-{number:03}"


def collecting(scene: int, number: int) -> str:
    """Name of an interaction while observations are collected; both numbers from 0."""
    return f"scene-{scene:05}-{number:03}"
