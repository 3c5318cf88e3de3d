"""The objects in the bin: shapes from installed packages and shapes built from convex parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError
from see2act.robot.types import RobotError, Split

GRIPPER_OPENING = 0.080
"""Metres between the open pads of the 2F-85 (0.086), less room for an error of placing."""


@dataclass(frozen=True)
class Shape:
    """A rigid shape as convex parts, metres, origin at its centre of volume."""

    name: str
    parts: tuple[trimesh.Trimesh, ...]

    @property
    def volume(self) -> float:
        """Cubic metres. Parts touch but do not overlap."""
        return float(sum(part.volume for part in self.parts))

    @property
    def width(self) -> float:
        """Metres that a gripper must span: the middle side of the bounding box of the largest part.

        Whichever face that lies on, one of its two horizontal sides is no longer than the middle one.
        """
        largest = max(self.parts, key=lambda part: part.volume)
        return float(np.sort(largest.extents)[1])

    def obj(self) -> str:
        """Wavefront text with one ``o`` group a part: Bullet makes each group a convex hull of its own."""
        lines, offset = [], 1
        for i, part in enumerate(self.parts):
            lines.append(f"o part{i}")
            lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices]
            lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in part.face_normals]
            normal = sum(len(p.faces) for p in self.parts[:i]) + 1
            lines += [
                "f " + " ".join(f"{v + offset}//{normal + k}" for v in face) for k, face in enumerate(part.faces.tolist())
            ]
            offset += len(part.vertices)
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class ObjectSet:
    """Which objects there are and how they vary.

    Args:
        name: The word people type.
        seen: Names from the catalogue that training uses.
        unseen: Names kept for evaluation.
        kinds: Different objects in a scene.
        copies: Copies of each.
        scale: Smallest and largest factor, drawn for each copy.
        density: kg/m^3; 250 is a hollow plastic toy.
    """

    name: str
    seen: tuple[str, ...]
    unseen: tuple[str, ...]
    kinds: int = 5
    copies: int = 2
    scale: tuple[float, float] = (0.8, 1.2)
    density: float = 250.0

    def __post_init__(self) -> None:
        for split in ("seen", "unseen"):
            names = getattr(self, split)
            if len(names) < self.kinds:
                raise RobotError(f"objects.{split} lists {len(names)} objects, a scene needs {self.kinds}")
            for name in names:
                self._check(name)
        if both := set(self.seen) & set(self.unseen):
            raise RobotError(f"objects.seen and objects.unseen share {sorted(both)}")

    def _check(self, name: str) -> None:
        if name not in CATALOGUE:
            raise RobotError(f"no object is called '{name}'; choose from {', '.join(sorted(CATALOGUE))}")
        if not 0 < self.scale[0] <= self.scale[1]:
            raise RobotError(f"objects.scale must be [low, high] with 0 < low <= high, got {list(self.scale)}")
        width = shape(name).width * self.scale[1]
        if width > GRIPPER_OPENING:
            raise RobotError(
                f"object '{name}' at scale {self.scale[1]} is {width * 1000:.0f} mm across and does not fit "
                f"the gripper's {GRIPPER_OPENING * 1000:.0f} mm: lower objects.scale"
            )

    def names(self, split: Split) -> tuple[str, ...]:
        """The objects of a split."""
        return self.seen if split == "seen" else self.unseen


@cache
def shape(name: str) -> Shape:
    """A shape of the catalogue, centred.

    Raises:
        RobotError: Its mesh file is missing or has no volume.
    """
    parts = CATALOGUE[name]()
    volumes = np.array([part.volume for part in parts])
    if not len(volumes) or (volumes <= 0).any():
        raise RobotError(f"object '{name}' has a part without volume")
    centre = sum(v * part.center_mass for v, part in zip(volumes, parts, strict=True)) / volumes.sum()
    for part in parts:
        part.apply_translation(-centre)
    return Shape(name, tuple(parts))


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh file (STL, OBJ, ...).

    Raises:
        RobotError: It does not exist, cannot be read, or encloses no volume.
    """
    if not path.is_file():
        raise RobotError(f"object file {path} does not exist: run `make install`, or check the path")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh lets through whatever its many readers raise
        raise RobotError(f"object file {path} is no mesh that trimesh can read: {error}") from None
    try:
        volume = mesh.convex_hull.volume
    except (QhullError, ValueError):  # fewer than four points, or all of them in a plane
        volume = 0.0
    if volume <= 0:
        raise RobotError(f"object file {path} has no volume: an object must be solid")
    return mesh


def _box(x: float, y: float, z: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box((x, y, z), trimesh.transformations.translation_matrix(at))


def _prism(corners: np.ndarray, height: float) -> trimesh.Trimesh:
    """A convex polygon (n, 2), extruded along z."""
    low = np.column_stack([corners, np.zeros(len(corners))])
    return trimesh.convex.convex_hull(np.concatenate([low, low + [0, 0, height]]))


def _half_round(radius: float, length: float) -> trimesh.Trimesh:
    angles = np.linspace(0, np.pi, 17)
    return _prism(radius * np.column_stack([np.cos(angles), np.sin(angles)]), length)


def _rgb_object(code: str, scale: float = 1.0) -> list[trimesh.Trimesh]:
    """One of DeepMind's RGB objects (Lee et al. 2021), from the package dm-robotics-manipulation."""
    ending = f"/{code}_"
    for file in metadata.files("dm-robotics-manipulation") or []:
        if "rgb_v1.3/meshes" in str(file) and ending in str(file) and str(file).endswith(".stl"):
            mesh = read_mesh(Path(str(file.locate()))).convex_hull
            mesh.apply_scale(scale)
            return [mesh]
    raise RobotError(f"mesh '{code}' is not in the installed package dm-robotics-manipulation: run `make install`")


# All sizes in metres at scale 1. Whatever face an object rests on, another one looks up within the cup's tilt: opposite
# sides are parallel, tapers are mild, and notches shallow, so that no shape leans on its tips with all faces askew. Faces
# are at least 28 mm wide, 22 mm at scale 0.8, for a cup of 18 mm.
CATALOGUE: dict[str, Callable[[], list[trimesh.Trimesh]]] = {
    "cube": lambda: [_box(0.045, 0.045, 0.045)],
    "brick": lambda: [_box(0.075, 0.045, 0.03)],
    "can": lambda: [trimesh.creation.cylinder(0.022, 0.065, sections=24)],
    "puck": lambda: [trimesh.creation.cylinder(0.030, 0.030, sections=24)],
    "ell": lambda: [_box(0.072, 0.03, 0.032), _box(0.03, 0.013, 0.032, (-0.021, 0.0215, 0))],
    "tee": lambda: [_box(0.078, 0.03, 0.032), _box(0.024, 0.010, 0.032, (0, 0.02, 0))],
    "aitch": lambda: [_box(0.025, 0.07, 0.032, (s * 0.017, 0, 0)) for s in (-1, 1)] + [_box(0.009, 0.03, 0.032)],
    "stairs": lambda: [_box(0.062, 0.045, 0.026), _box(0.031, 0.045, 0.010, (-0.0155, 0, 0.018))],
    "hexagon": lambda: _rgb_object("h2"),
    "leaning": lambda: _rgb_object("m25"),
    "wedge": lambda: _rgb_object("u3"),
    "taper": lambda: _rgb_object("x36"),
    "ramp": lambda: _rgb_object("h38"),
    "bar": lambda: _rgb_object("m26", 0.9),
    "keel": lambda: _rgb_object("r56", 0.8),
    "decagon": lambda: _rgb_object("r2"),
    "slant": lambda: _rgb_object("m5", 0.9),
    "channel": lambda: [_box(0.074, 0.05, 0.026)] + [_box(0.02, 0.05, 0.014, (s * 0.027, 0, 0.020)) for s in (-1, 1)],
    "zed": lambda: [_box(0.06, 0.028, 0.032), _box(0.06, 0.028, 0.032, (0.010, 0.028, 0))],
    "arch": lambda: [_half_round(0.032, 0.06)],
}
