"""Shapes modelled on the objects of the paper's real set-up: toy blocks, fruit, decorative and office objects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from see2act.robot.solids import box, cone, cylinder, ellipsoid, half_round, prism, ring

Parts = list[trimesh.Trimesh]


def _polygon(sides: int, radius: float, turn: float = 0.0) -> np.ndarray:
    turns = turn + 2 * np.pi * np.arange(sides) / sides
    return radius * np.column_stack([np.cos(turns), np.sin(turns)])


def _star(points: int, inner: float, outer: float, height: float) -> Parts:
    """A star: a regular polygon with a triangle on each side."""
    core, tips = _polygon(points, inner), _polygon(points, outer, np.pi / points)
    triangles = [np.array([core[i], core[(i + 1) % points], tips[i]]) for i in range(points)]
    return [prism(corners, height) for corners in (core, *triangles)]


def _arc(radius: float, thick: float, sweep: float, parts: int) -> Parts:
    """A bent bar with thinner ends: a banana or a moon."""
    turns = np.linspace(-sweep / 2, sweep / 2, parts + 1)
    width = thick * (0.55 + 0.45 * np.cos(turns / sweep * 2.6))
    segments = []
    for i in range(parts):
        corners = [
            (radius + s * w / 2) * np.array([np.cos(t), np.sin(t)])
            for t, w in ((turns[i], width[i]), (turns[i + 1], width[i + 1]))
            for s in (-1, 1)
        ]
        segments.append(prism(np.array(corners), float(width[i : i + 2].mean())))
    return segments


def _up(part: trimesh.Trimesh, z: float) -> trimesh.Trimesh:
    return part.copy().apply_translation([0, 0, z])


HOUSEHOLD: dict[str, Callable[[], Parts]] = {
    # toy blocks
    "block": lambda: [box(0.04, 0.04, 0.04)],
    "plank": lambda: [box(0.095, 0.036, 0.022)],
    "tile": lambda: [box(0.05, 0.05, 0.018)],
    "roof": lambda: [prism(np.array([[-0.036, 0], [0.036, 0], [0, 0.018]]), 0.06)],
    "column": lambda: [cylinder(0.018, 0.06)],
    "dome": lambda: [half_round(0.03, 0.036)],
    "bridge": lambda: [box(0.08, 0.032, 0.022), *(box(0.022, 0.032, 0.016, (s * 0.029, 0, -0.019)) for s in (-1, 1))],
    "corner_block": lambda: [box(0.06, 0.028, 0.03), box(0.028, 0.03, 0.03, (-0.016, 0.029, 0))],
    # fruit
    "apple": lambda: [ellipsoid(0.034, 0.034, 0.030)],
    "orange": lambda: [ellipsoid(0.033, 0.033, 0.033)],
    "lemon": lambda: [ellipsoid(0.036, 0.025, 0.025)],
    "plum": lambda: [ellipsoid(0.025, 0.022, 0.022)],
    "pear": lambda: [cone(0.027, 0.018, 0.04), _up(cone(0.018, 0.027, 0.02), -0.02)],
    "banana": lambda: _arc(0.07, 0.030, 1.4, 5),
    "strawberry": lambda: [cone(0.016, 0.024, 0.034)],
    "kiwi": lambda: [ellipsoid(0.032, 0.026, 0.024)],
    # decorative
    "star": lambda: _star(5, 0.020, 0.042, 0.024),
    "medal": lambda: [prism(_polygon(8, 0.034), 0.028)],
    "egg": lambda: [ellipsoid(0.030, 0.022, 0.022)],
    "pyramid": lambda: [cone(0.034, 0.022, 0.034, 4)],
    "gem": lambda: [cone(0.022, 0.034, 0.020, 6), _up(cone(0.034, 0.022, 0.020, 6), 0.020)],
    "hexagon_box": lambda: [prism(_polygon(6, 0.030), 0.032)],
    "moon": lambda: _arc(0.036, 0.026, 2.4, 6),
    "candle": lambda: [cylinder(0.022, 0.045)],
    "bowl_foot": lambda: [cone(0.034, 0.024, 0.040)],
    # office
    "eraser": lambda: [box(0.055, 0.026, 0.016)],
    "marker": lambda: [cylinder(0.015, 0.110, sides=16)],
    "tape": lambda: ring(0.016, 0.033, 0.022, 10),
    "stapler": lambda: [box(0.09, 0.03, 0.014), box(0.075, 0.022, 0.018, (-0.0075, 0, 0.016))],
    "notepad": lambda: [box(0.07, 0.052, 0.016)],
    "glue": lambda: [cylinder(0.015, 0.075, sides=16)],
    "stamp": lambda: [box(0.044, 0.032, 0.018), cylinder(0.012, 0.034, (0, 0, 0.026), 12)],
    "nut": lambda: ring(0.012, 0.030, 0.022, 6),
    # transparent for the depth sensor
    "tumbler": lambda: [cone(0.024, 0.032, 0.062)],
    "vial": lambda: [cylinder(0.016, 0.070, sides=16)],
}
"""Convex parts by object, metres at scale 1.

Whichever side an object rests on, a face points up within the cup's 30 degrees, and no such face is too round for an 18 mm
cup to follow. An object that no cup can hold would stay in the bin and use up the attempts of every test run.
"""
