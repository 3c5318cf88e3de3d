"""Stored layouts of settled scenes, so that each scene is dropped only once."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from see2act.errors import DamagedFile
from see2act.files import damaged, read_json, write_json
from see2act.robot.types import Split

log = logging.getLogger("see2act")
Refusal = Literal["restless", "spilled", "scattered"]
"""Why a scene is dropped again: objects do not come to rest, lie outside the bin, or lie too far apart."""


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
    """The objects of a settled scene and their poses."""

    objects: tuple[Placed, ...]
    refused: tuple[Refusal, ...] = ()
    """Why the drops before this one were refused."""


class Layouts:
    """Layouts by scene, in a folder of small files. Several processes may use it at the same time.

    Args:
        folder: Folder for scenes made by the same code and packages, with the same bin and objects. None stores nothing.
    """

    def __init__(self, folder: Path | None):
        self._folder = folder

    def get(self, scene_seed: int, split: Split, count: int | None) -> Layout | None:
        """The layout of a scene, or None if it is not stored. One that is damaged counts as not stored."""
        path = self._path(scene_seed, split, count)
        if path is None or not path.exists():
            return None
        try:
            return _read(path)
        except DamagedFile as error:
            log.warning("%s is damaged, and is made again: %s", path, error)
            return None

    def keep(self, layout: Layout, scene_seed: int, split: Split, count: int | None) -> None:
        """Store a layout. JSON keeps floats exactly."""
        path = self._path(scene_seed, split, count)
        if path is not None:
            write_json(path, asdict(layout))

    def _path(self, scene_seed: int, split: Split, count: int | None) -> Path | None:
        name = f"{split}-{'all' if count is None else count}-{scene_seed}.json"
        return self._folder / name if self._folder else None


def _read(path: Path) -> Layout:
    kept = read_json(path)
    try:
        objects = tuple(
            Placed(o["name"], o["scale"], tuple(o["color"]), tuple(o["position"]), tuple(o["rotation"]))
            for o in kept["objects"]
        )
        return Layout(objects, tuple(kept["refused"]))
    except (KeyError, TypeError) as error:
        raise damaged(path, error) from None
