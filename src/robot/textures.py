"""Grey patterns, by which an object's colour is multiplied."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8

from see2act.seeding import generator

SIDE = 64
"""Pixels per side of a texture."""
DARK = 90
"""Grey value of the dark parts; the others are 255."""
ROWS, COLS = np.indices((SIDE, SIDE))


def _grey(dark: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.repeat(np.where(dark, DARK, 255).astype(np.uint8)[..., None], 3, axis=-1)


def _speckles() -> UInt8[np.ndarray, "h w 3"]:
    return _grey(generator("texture/speckles").random((SIDE // 4, SIDE // 4)).repeat(4, 0).repeat(4, 1) < 0.15)


TEXTURES: dict[str, Callable[[], UInt8[np.ndarray, "h w 3"]]] = {
    "stripes": lambda: _grey(COLS % 16 < 4),
    "checks": lambda: _grey((ROWS // 16 + COLS // 16) % 2 == 0),
    "dots": lambda: _grey((ROWS % 32 - 16) ** 2 + (COLS % 32 - 16) ** 2 < 49),
    "label": lambda: _grey((ROWS > 16) & (ROWS < 44) & (ROWS % 7 < 3) & (COLS > 8) & (COLS < 56)),
    "speckles": _speckles,
}
"""Functions that make an RGB image, by the name used in the configuration."""
