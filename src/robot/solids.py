"""Convex solids, from which objects are built. Lengths are in metres; each function chooses its own origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError

from see2act.robot.packages import package_file
from see2act.robot.types import RobotError


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read a mesh file (STL, OBJ, ...).

    Raises:
        RobotError: The file does not exist, cannot be read, has vertices that are not finite, or has no volume.
    """
    if not path.is_file():
        raise RobotError(f"object file {path} does not exist: run `make install`, or check the path")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        whole = bool(np.isfinite(mesh.vertices).all())
        mesh.process()  # would drop vertices that are no numbers, and the faces between them
    except Exception as error:  # trimesh passes on whatever its many readers raise
        raise RobotError(f"object file {path} is no mesh that trimesh can read: {error}") from None
    if not whole:
        raise RobotError(f"object file {path} has vertices that are no finite numbers: export it again")
    try:
        volume = mesh.convex_hull.volume
    except (QhullError, ValueError):  # fewer than four points, or all of them in a plane
        volume = 0.0
    if volume <= 0:
        raise RobotError(f"object file {path} has no volume: an object must be solid")
    return mesh


def box(x: float, y: float, z: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """A box with sides ``x``, ``y`` and ``z``, centred at ``at``."""
    return trimesh.creation.box((x, y, z), trimesh.transformations.translation_matrix(at))


def prism(corners: np.ndarray, height: float) -> trimesh.Trimesh:
    """A convex polygon with ``corners`` (n, 2), extruded along z."""
    low = np.column_stack([corners, np.zeros(len(corners))])
    return trimesh.convex.convex_hull(np.concatenate([low, low + [0, 0, height]]))


def half_round(radius: float, length: float) -> trimesh.Trimesh:
    """Half of a cylinder along z that is cut lengthwise."""
    angles = np.linspace(0, np.pi, 17)
    return prism(radius * np.column_stack([np.cos(angles), np.sin(angles)]), length)


def rgb_object(code: str, scale: float = 1.0) -> list[trimesh.Trimesh]:
    """One of DeepMind's RGB objects (Lee et al. 2021), from the package dm-robotics-manipulation."""
    mesh = read_mesh(package_file("dm-robotics-manipulation", f"*rgb_v1.3/meshes*/{code}_*.stl")).convex_hull
    mesh.apply_scale(scale)
    return [mesh]


def cylinder(radius: float, height: float, at: tuple[float, float, float] = (0, 0, 0), sides: int = 24) -> trimesh.Trimesh:
    """A cylinder along z, centred at ``at``."""
    return trimesh.creation.cylinder(radius, height, sections=sides).apply_translation(at)


def cone(low: float, high: float, height: float, sides: int = 20) -> trimesh.Trimesh:
    """A truncated cone with radius ``low`` at the bottom and ``high`` at the top, standing on z = 0."""
    turns = 2 * np.pi * np.arange(sides) / sides
    rim = np.column_stack([np.cos(turns), np.sin(turns)])
    rings = [np.column_stack([r * rim, np.full(sides, z)]) for r, z in ((low, 0.0), (high, height))]
    return trimesh.convex.convex_hull(np.concatenate(rings))


def ellipsoid(x: float, y: float, z: float) -> trimesh.Trimesh:
    """An ellipsoid with semi-axes ``x``, ``y`` and ``z``."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    return trimesh.convex.convex_hull(ball.vertices * [x, y, z])


def ring(inner: float, outer: float, height: float, sides: int) -> list[trimesh.Trimesh]:
    """A ring with ``sides`` convex parts. With few sides it looks like a nut."""
    turns = 2 * np.pi * np.arange(sides + 1) / sides
    rim = np.column_stack([np.cos(turns), np.sin(turns)])
    return [prism(np.concatenate([inner * rim[i : i + 2], outer * rim[i : i + 2]]), height) for i in range(sides)]
