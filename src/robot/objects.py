"""The objects in the bin: shapes from installed packages, and shapes built from convex parts."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import trimesh

from see2act.robot.household import HOUSEHOLD
from see2act.robot.solids import box, half_round, rgb_object
from see2act.robot.textures import TEXTURES
from see2act.robot.types import RobotError, Split

TILE = 0.03
"""Side of the square that one tile of a texture covers, metres."""
MOST = 1000
"""Objects in a scene."""
GRIPPER_OPENING = 0.080
"""Opening of the 2F-85 (0.086 m) minus a margin for placement errors, metres."""


@dataclass(frozen=True)
class Shape:
    """A rigid shape made of convex parts, in metres. The origin is at its centre of volume."""

    name: str
    parts: tuple[trimesh.Trimesh, ...]

    @property
    def volume(self) -> float:
        """Cubic metres. The parts may touch but do not overlap."""
        return float(sum(part.volume for part in self.parts))

    @property
    def width(self) -> float:
        """Metres that a gripper must span: the middle side of the bounding box of the largest part.

        Whichever face of that box is at the bottom, one of the two horizontal sides is no longer than the middle side.
        """
        largest = max(self.parts, key=lambda part: part.volume)
        return float(np.sort(largest.extents)[1])

    def obj(self) -> str:
        """Wavefront OBJ text with one ``o`` group per part. Bullet makes a separate convex hull of each group.

        Each face is textured by projection along the axis that it faces most, with one tile every 3 cm.
        """
        lines, vertices, faces = [], 1, 0
        for i, part in enumerate(self.parts):
            lines.append(f"o part{i}")
            lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices]
            lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in part.face_normals]
            for k, face in enumerate(part.faces):
                on_face = np.delete(part.vertices[face], np.abs(part.face_normals[k]).argmax(), axis=1) / TILE
                lines += [f"vt {u:.4f} {v:.4f}" for u, v in on_face]
                n = faces + k
                lines.append("f " + " ".join(f"{v + vertices}/{3 * n + c + 1}/{n + 1}" for c, v in enumerate(face)))
            vertices += len(part.vertices)
            faces += len(part.faces)
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class ObjectSet:
    """A set of objects, and how they vary.

    Args:
        name: Name used in the configuration.
        seen: Names from the catalogue for training.
        unseen: Names from the catalogue that are kept for evaluation.
        kinds: Number of different objects in a scene.
        copies: Number of copies of each.
        scale: Smallest and largest scale factor; a factor is drawn for each copy.
        density: kg/m^3; 250 is a hollow plastic toy.
        opening: Metres that the widest object may span; wider ones do not fit between the open pads.
        textures: Names from :mod:`see2act.robot.textures`, by object.
        transparent: Objects that the depth sensor sees through.

    Raises:
        RobotError: An object is unknown, too wide, or both seen and unseen; there are too few objects; ``scale``, ``density``,
            ``kinds`` or ``copies`` is out of range; or a texture is unknown.
    """

    name: str
    seen: tuple[str, ...]
    unseen: tuple[str, ...]
    kinds: int = 5
    copies: int = 2
    scale: tuple[float, float] = (0.8, 1.2)
    density: float = 250.0
    opening: float = GRIPPER_OPENING
    textures: dict[str, str] = field(default_factory=dict)
    transparent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 < self.scale[0] <= self.scale[1]:
            raise RobotError(f"objects.scale must be [low, high] with 0 < low <= high, got {list(self.scale)}")
        if not self.density > 0:
            raise RobotError(f"objects.density={self.density} must be above 0: it is in kg/m^3")
        if min(self.kinds, self.copies) < 1:
            raise RobotError(f"objects.kinds={self.kinds} and objects.copies={self.copies} must be at least 1")
        if self.kinds * self.copies > MOST:
            raise RobotError(
                f"objects.kinds={self.kinds} and objects.copies={self.copies} are more objects than a bin holds: {MOST} at most"
            )
        for split in ("seen", "unseen"):
            names = getattr(self, split)
            if len(names) < self.kinds:
                raise RobotError(f"objects.{split} lists {len(names)} objects, a scene needs {self.kinds}")
            for name in names:
                self._check(name)
        if both := set(self.seen) & set(self.unseen):
            raise RobotError(f"objects.seen and objects.unseen share {sorted(both)}")
        for key, names in (("textures", tuple(self.textures)), ("transparent", self.transparent)):
            if strangers := set(names) - {*self.seen, *self.unseen}:
                raise RobotError(f"objects.{key} names {sorted(strangers)}, which are neither seen nor unseen")
        if unknown := set(self.textures.values()) - set(TEXTURES):
            raise RobotError(f"no texture is called {sorted(unknown)}; choose from {', '.join(TEXTURES)}")

    def _check(self, name: str) -> None:
        width = self.shape(name).width * self.scale[1]
        if width > self.opening:
            raise RobotError(
                f"object '{name}' at scale {self.scale[1]} is {width * 1000:.0f} mm across and does not fit "
                f"the gripper's {self.opening * 1000:.0f} mm: lower objects.scale"
            )

    def names(self, split: Split) -> tuple[str, ...]:
        """The objects of a split."""
        return self.seen if split == "seen" else self.unseen

    def shape(self, name: str) -> Shape:
        """The shape of an object at scale 1.

        Raises:
            RobotError: There is no object of this name, or its mesh file is missing or has no volume.
        """
        if name not in CATALOGUE:
            raise RobotError(f"no object is called '{name}'; choose from {', '.join(sorted(CATALOGUE))}")
        return shape(name)


@cache
def shape(name: str) -> Shape:
    """A shape of the catalogue, centred at its centre of volume.

    Raises:
        RobotError: Its mesh file is missing or has no volume.
    """
    return centred(name, CATALOGUE[name]())


def centred(name: str, parts: Sequence[trimesh.Trimesh]) -> Shape:
    """Combine convex parts into a shape whose centre of volume is at the origin.

    Raises:
        RobotError: A part has no volume.
    """
    volumes = np.array([part.volume for part in parts])
    if not len(volumes) or (volumes <= 0).any():
        raise RobotError(f"object '{name}' has a part without volume")
    centre = sum(v * part.center_mass for v, part in zip(volumes, parts, strict=True)) / volumes.sum()
    for part in parts:
        part.apply_translation(-centre)
    return Shape(name, tuple(parts))


# All sizes are in metres at scale 1. Whichever face an object rests on, another face points up within the cup's tilt. For
# this, opposite sides are parallel, tapers are mild and notches are shallow, so that no shape can lean on its tips with all
# faces tilted. Faces are at least 28 mm wide (22 mm at scale 0.8), for a cup of 18 mm.
CATALOGUE: dict[str, Callable[[], list[trimesh.Trimesh]]] = {
    "cube": lambda: [box(0.045, 0.045, 0.045)],
    "brick": lambda: [box(0.075, 0.045, 0.03)],
    "can": lambda: [trimesh.creation.cylinder(0.022, 0.065, sections=24)],
    "puck": lambda: [trimesh.creation.cylinder(0.030, 0.030, sections=24)],
    "ell": lambda: [box(0.072, 0.03, 0.032), box(0.03, 0.013, 0.032, (-0.021, 0.0215, 0))],
    "tee": lambda: [box(0.078, 0.03, 0.032), box(0.024, 0.010, 0.032, (0, 0.02, 0))],
    "aitch": lambda: [box(0.025, 0.07, 0.032, (s * 0.017, 0, 0)) for s in (-1, 1)] + [box(0.009, 0.03, 0.032)],
    "stairs": lambda: [box(0.062, 0.045, 0.026), box(0.031, 0.045, 0.010, (-0.0155, 0, 0.018))],
    "hexagon": lambda: rgb_object("h2"),
    "leaning": lambda: rgb_object("m25"),
    "wedge": lambda: rgb_object("u3"),
    "taper": lambda: rgb_object("x36"),
    "ramp": lambda: rgb_object("h38"),
    "bar": lambda: rgb_object("m26", 0.9),
    "keel": lambda: rgb_object("r56", 0.8),
    "decagon": lambda: rgb_object("r2"),
    "slant": lambda: rgb_object("m5", 0.9),
    "channel": lambda: [box(0.074, 0.05, 0.026)] + [box(0.02, 0.05, 0.014, (s * 0.027, 0, 0.020)) for s in (-1, 1)],
    "zed": lambda: [box(0.06, 0.028, 0.032), box(0.06, 0.028, 0.032, (0.010, 0.028, 0))],
    "arch": lambda: [half_round(0.032, 0.06)],
    **HOUSEHOLD,
}


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A uniformly random unit quaternion, xyzw."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def random_color(rng: np.random.Generator) -> tuple[float, float, float]:
    """A random colour, RGB in 0..1: any hue, neither pale nor dark."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.5, 1.0), rng.uniform(0.5, 1.0))
