"""Objects that nobody here shaped: mesh files, made convex, centred and brought to a size that fits the gripper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pybullet_data
import trimesh
from see2act.robot.objects import GRIPPER_OPENING, ObjectSet, Shape, centred
from see2act.robot.solids import read_mesh
from see2act.robot.types import RobotError

ENDINGS = (".obj", ".stl")
CONVEX = 0.95
"""Share of its convex hull that a mesh fills at least to be taken for convex."""
PARTS = 16
"""Convex parts that a mesh is cut into at most."""
SMALLEST, LARGEST = 0.01, 0.15
"""Metres between which the sides of an object's bounding box must lie: a finger's width, and half of a bin."""


@dataclass(frozen=True)
class MeshSet(ObjectSet):
    """Objects from files.

    Args:
        files: Where each object's mesh is, by name.
        unit: Metres a unit of the files.
        width: Metres to which the middle side of each object's bounding box is brought; None leaves sizes as they are.
    """

    files: dict[str, Path] = field(default_factory=dict)
    unit: float = 1.0
    width: float | None = None

    def shape(self, name: str) -> Shape:
        return mesh_shape(name, self.files[name], self.unit, self.width)

    def _check(self, name: str) -> None:
        if self.width is None:  # otherwise they fit by construction, and there may be hundreds
            super()._check(name)


def random_urdfs(
    name: str, held_out: int, width: float, kinds: int, copies: int, scale: Sequence[float], density: float
) -> MeshSet:
    """The thousand procedural objects that come with PyBullet, the last ones by name unseen.

    Args:
        name: The word people type.
        held_out: How many are unseen.
        width: Metres of the middle side of each at scale 1.
        kinds, copies, scale, density: As of :class:`ObjectSet`.

    Raises:
        RobotError: The largest would not fit the gripper.
    """
    root = Path(pybullet_data.getDataPath()) / "random_urdfs"
    files = {f"urdf{path.stem}": path for path in sorted(root.glob("*/*.obj"))}
    if width * scale[1] > GRIPPER_OPENING:
        raise RobotError(f"objects.width={width} at scale {scale[1]} does not fit the gripper's {GRIPPER_OPENING} m: lower one")
    return _mesh_set(name, files, held_out, kinds, copies, scale, density, 1.0, width)


def folder(
    name: str,
    path: str,
    unit: float,
    held_out: float,
    width: float | None,
    kinds: int,
    copies: int,
    scale: Sequence[float],
    density: float,
) -> MeshSet:
    """All OBJ and STL files in a folder, the last ones by name unseen.

    Args:
        name: The word people type.
        path: The folder; those in it are searched too.
        unit: Metres a unit of the files: 0.001 for millimetres.
        held_out: Share of them that is unseen.
        width: Metres of the middle side of each at scale 1; None leaves sizes as they are.
        kinds, copies, scale, density: As of :class:`ObjectSet`.

    Raises:
        RobotError: The folder is none or has too few files, two have the same name, or an object has no volume or an
            impossible size.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise RobotError(f"objects.path={path} is no folder: give one that holds .obj or .stl files")
    found = sorted(file for file in root.rglob("*") if file.suffix.lower() in ENDINGS)
    files = {file.stem: file for file in found}
    if len(files) < len(found):
        twice = next(file for file in found if files[file.stem] != file)
        raise RobotError(f"{twice} and {files[twice.stem]} would be one object: rename one of them")
    unseen = round(held_out * len(files))
    if min(unseen, len(files) - unseen) < kinds:
        raise RobotError(
            f"objects.path={path} holds {len(files)} objects, {unseen} of them unseen, and a scene needs {kinds}: add files, "
            "lower objects.kinds or change objects.held_out"
        )
    for key, file in files.items():
        _check_size(mesh_shape(key, file, unit, width), file)
    return _mesh_set(name, files, unseen, kinds, copies, scale, density, unit, width)


@cache
def mesh_shape(name: str, file: Path, unit: float, width: float | None) -> Shape:
    """A mesh file as convex parts: its bodies, each cut into convex parts unless it nearly fills its hull.

    Raises:
        RobotError: The file is missing, no mesh, or has no volume.
    """
    bodies = read_mesh(file).split(only_watertight=False)
    hulls = [hull for body in bodies if len(body.faces) > 3 for hull in _convex(body)]
    sides = np.sort(np.ptp(np.concatenate([hull.vertices for hull in hulls]), axis=0))
    factor = unit if width is None else width / sides[1]
    for hull in hulls:
        hull.apply_scale(factor)
    return centred(name, hulls)


def _convex(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Its hull, or its decomposition by V-HACD (Mamou 2016); what is not closed has no inside, and is its hull."""
    hull = mesh.convex_hull
    if not mesh.is_volume or mesh.volume > CONVEX * hull.volume:
        return [hull]
    parts = trimesh.decomposition.convex_decomposition(mesh, maxConvexHulls=PARTS)
    return [trimesh.Trimesh(**part).convex_hull for part in parts]


def _check_size(shape: Shape, file: Path) -> None:
    points = np.concatenate([part.vertices for part in shape.parts])
    sides = np.sort(np.ptp(points, axis=0))
    if sides[0] < SMALLEST or sides[2] > LARGEST:
        told = " x ".join(f"{side:.3g}" for side in sides)
        raise RobotError(
            f"{file} is {told} m, and sides must lie between {SMALLEST} and {LARGEST} m: give objects.unit, metres a unit of "
            "the file (0.001 for millimetres), or objects.width=0.05 to bring all to one size"
        )


def _mesh_set(
    name: str,
    files: dict[str, Path],
    unseen: int,
    kinds: int,
    copies: int,
    scale: Sequence[float],
    density: float,
    unit: float,
    width: float | None,
) -> MeshSet:
    names = tuple(sorted(files))
    low, high = scale
    return MeshSet(
        name,
        names[: len(names) - unseen],
        names[len(names) - unseen :],
        kinds,
        copies,
        (low, high),
        density,
        files=files,
        unit=unit,
        width=width,
    )
