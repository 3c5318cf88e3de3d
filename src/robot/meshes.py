"""Objects from mesh files: split into convex parts, centred, and scaled to a size that fits the gripper."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pybullet_data
import trimesh

from see2act.robot.objects import ObjectSet, Shape, centred
from see2act.robot.solids import read_mesh
from see2act.robot.types import RobotError

log = logging.getLogger("see2act")
ENDINGS = (".obj", ".stl")
CONVEX = 0.95
"""A mesh counts as convex if it fills more than this share of its convex hull."""
PARTS, RESOLUTION = 16, 100_000
"""Maximum number of convex parts per body, and number of voxels that V-HACD uses: a second or two per body."""
EMPTY = ("168",)
"""Those of PyBullet's thousand objects whose files have no valid vertex."""
MOST_PARTS = 128
"""Maximum number of convex parts of an object. Contacts are computed between all parts of neighbouring objects.

PyBullet's procedural objects have up to 127.
"""
SMALLEST, LARGEST = 0.01, 0.15
"""Bounds for the sides of an object's bounding box, metres: the width of a finger, and what can lie flat among ten objects."""


@dataclass(frozen=True)
class MeshSet(ObjectSet):
    """Objects from files.

    Args:
        files: Path of each object's mesh, by name.
        unit: Metres per unit of the files.
        width: Metres to which the middle side of each object's bounding box is scaled; None keeps the sizes of the files.
    """

    files: dict[str, Path] = field(default_factory=dict)
    unit: float = 1.0
    width: float | None = None

    def __post_init__(self) -> None:
        for key, value in (("unit", self.unit), ("width", self.width)):
            if value is not None and value <= 0:
                raise RobotError(f"objects.{key}={value} must be above 0")
        if self.width and self.width * self.scale[1] > self.opening:
            raise RobotError(
                f"objects.width={self.width} at scale {self.scale[1]} does not fit the gripper's {self.opening} m: lower one"
            )
        super().__post_init__()

    def shape(self, name: str) -> Shape:
        return mesh_shape(name, self.files[name], self.unit, self.width)

    def _check(self, name: str) -> None:
        """Check nothing: there may be hundreds of files. The functions that make a set check what they need."""


def random_urdfs(
    name: str,
    held_out: int,
    width: float,
    kinds: int,
    copies: int,
    scale: Sequence[float],
    density: float,
    opening: float,
) -> MeshSet:
    """The thousand procedural objects that come with PyBullet, except for an empty one. The last ones by name are unseen.

    Args:
        name: Name used in the configuration.
        held_out: Number of unseen objects.
        width: Middle side of each object at scale 1, metres; smaller where the longest side would exceed 15 cm.
        kinds, copies, scale, density, opening: As for :class:`ObjectSet`.

    Raises:
        RobotError: The largest object would not fit the gripper.
    """
    root = Path(pybullet_data.getDataPath()) / "random_urdfs"
    files = {f"urdf{path.stem}": path for path in sorted(root.glob("*/*.obj")) if path.stem not in EMPTY}
    split = _split(files, held_out)
    return MeshSet(name, *split, kinds, copies, (scale[0], scale[1]), density, opening, files=files, width=width)


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
    opening: float,
) -> MeshSet:
    """All OBJ and STL files in a folder. The last ones by name are unseen.

    Args:
        name: Name used in the configuration.
        path: The folder. Its subfolders are searched too.
        unit: Metres per unit of the files: 0.001 for millimetres.
        held_out: Share of the objects that is unseen.
        width: Middle side of each object at scale 1, metres; None keeps the sizes of the files.
        kinds, copies, scale, density, opening: As for :class:`ObjectSet`.

    Raises:
        RobotError: The folder does not exist or has too few files; two files have the same name; or an object has no volume,
            or does not fit the gripper or the bin.
    """
    files = _mesh_files(path)
    unseen = round(held_out * len(files))
    if min(unseen, len(files) - unseen) < kinds:
        raise RobotError(
            f"objects.path={path} holds {len(files)} objects, {unseen} of them unseen, and a scene needs {kinds}: add files, "
            "lower objects.kinds or change objects.held_out"
        )
    split = _split(files, unseen)
    objects = MeshSet(name, *split, kinds, copies, (scale[0], scale[1]), density, opening, files=files, unit=unit, width=width)
    for key, file in files.items():
        _check_size(objects.shape(key), file, objects)
    return objects


def _mesh_files(path: str) -> dict[str, Path]:
    """The OBJ and STL files in a folder and its subfolders, by object name, which is the file's name without its ending.

    Raises:
        RobotError: The folder does not exist, or two files have the same name.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        raise RobotError(f"objects.path={path} is no folder: give one that holds .obj or .stl files")
    found = sorted(file for file in root.rglob("*") if file.suffix.lower() in ENDINGS)
    files = {file.stem: file for file in found}
    if len(files) < len(found):
        twice = next(file for file in found if files[file.stem] != file)
        raise RobotError(f"{twice} and {files[twice.stem]} would be one object: rename one of them")
    return files


def _split(files: dict[str, Path], unseen: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    names = tuple(sorted(files))
    return names[: len(names) - unseen], names[len(names) - unseen :]


@cache
def mesh_shape(name: str, file: Path, unit: float, width: float | None) -> Shape:
    """Convert a mesh file to convex parts. Each of its bodies is decomposed unless it nearly fills its convex hull.

    Raises:
        RobotError: The file is missing, is not a mesh, has no volume, or gives more than ``MOST_PARTS`` parts.
    """
    mesh = read_mesh(file)
    # Files repeat a vertex for each of its normals and texture coordinates. Without this a cube would be six separate faces.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    bodies = [body for body in mesh.split(only_watertight=False) if _solid(body)]
    hulls = [hull for body in bodies or [mesh] for hull in _convex(body, file)]
    if len(hulls) > MOST_PARTS:
        raise RobotError(f"{file} is of {len(hulls)} convex parts, more than {MOST_PARTS}: simplify it")
    sides = _sides(hulls)
    factor = unit if width is None else min(width / sides[1], LARGEST / sides[2])
    for hull in hulls:
        hull.apply_scale(factor)
    return centred(name, hulls)


def _solid(body: trimesh.Trimesh) -> bool:
    """Whether a body is not flat. Labels and ground planes are flat and not counted as bodies."""
    sides = np.sort(body.extents)
    return bool(len(body.faces) > 3 and sides[0] > 1e-3 * sides[2])


def _convex(mesh: trimesh.Trimesh, file: Path) -> list[trimesh.Trimesh]:
    """The convex hull of a mesh, or its decomposition by V-HACD (Mamou 2016). A mesh that is not closed becomes its hull."""
    hull = mesh.convex_hull
    if mesh.is_watertight:
        trimesh.repair.fix_normals(mesh)
    if not mesh.is_volume:
        log.info("objects: %s is not closed, and is taken for its convex hull", file.name)
    if not mesh.is_volume or mesh.volume > CONVEX * hull.volume:
        return [hull]
    log.info("objects: cutting %s into convex parts", file.name)
    parts = trimesh.decomposition.convex_decomposition(mesh, maxConvexHulls=PARTS, resolution=RESOLUTION)
    return [trimesh.Trimesh(**part).convex_hull for part in parts]


def _sides(parts: Sequence[trimesh.Trimesh]) -> np.ndarray:
    """Sides of the bounding box of all parts, shortest first."""
    return np.sort(np.ptp(np.concatenate([part.vertices for part in parts]), axis=0))


def _check_size(shape: Shape, file: Path, objects: MeshSet) -> None:
    sides = _sides(shape.parts)
    if sides[0] < SMALLEST or sides[2] > LARGEST * (1 + 1e-6):
        told = " x ".join(f"{side:.3g}" for side in sides)
        raise RobotError(
            f"{file} is {told} m, and sides must lie between {SMALLEST} and {LARGEST} m: set objects.unit to the "
            "metres in one unit of the file (0.001 for millimetres), or objects.width=0.05 to bring all to one size"
        )
    across = sides[1] * objects.scale[1]
    if across > objects.opening:
        raise RobotError(
            f"{file} at scale {objects.scale[1]} is {across * 1000:.0f} mm across and does not fit the gripper's "
            f"{objects.opening * 1000:.0f} mm: lower objects.scale, give objects.width=0.05, or objects.opening of your tool"
        )
