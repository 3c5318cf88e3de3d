"""Settled scenes, kept so that each is dropped once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from see2act.files import read_json, write_json
from see2act.robot.types import Split

Refusal = Literal["restless", "spilled", "scattered"]
"""Why a scene is dropped again: objects that do not come to rest, that lie outside the bin, that lie apart."""


@dataclass(frozen=True)
class Placed:
    """An object at rest."""

    name: str
    scale: float
    color: tuple[float, float, float]
    position: tuple[float, float, float]
    """World position of its centre of mass, metres."""
    rotation: tuple[float, float, float, float]
    """Quaternion, xyzw."""


@dataclass(frozen=True)
class Layout:
    """What lies where in a settled scene."""

    objects: tuple[Placed, ...]
    refused: tuple[Refusal, ...] = ()
    """Why the drops before this one were refused."""


class Layouts:
    """Layouts by scene, in a folder of small files; processes may share it.

    Args:
        folder: Of scenes that were all made alike: by the same code, packages, bin and objects. None keeps nothing.
    """

    def __init__(self, folder: Path | None):
        self._folder = folder

    def get(self, scene_seed: int, split: Split, count: int | None) -> Layout | None:
        """The layout of a scene, or None where it was not kept.

        Raises:
            DamagedFile: Its file is no JSON.
        """
        path = self._path(scene_seed, split, count)
        if path is None or not path.exists():
            return None
        kept = read_json(path)
        objects = (
            Placed(o["name"], o["scale"], tuple(o["color"]), tuple(o["position"]), tuple(o["rotation"]))
            for o in kept["objects"]
        )
        return Layout(tuple(objects), tuple(kept["refused"]))

    def keep(self, layout: Layout, scene_seed: int, split: Split, count: int | None) -> None:
        """Write a layout; JSON keeps every bit of a float."""
        path = self._path(scene_seed, split, count)
        if path is not None:
            write_json(path, asdict(layout))

    def _path(self, scene_seed: int, split: Split, count: int | None) -> Path | None:
        name = f"{split}-{'all' if count is None else count}-{scene_seed}.json"
        return self._folder / name if self._folder else None
