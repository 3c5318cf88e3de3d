"""Named seeds: every random generator of a run is seeded from a name and integers."""

from __future__ import annotations

import hashlib

import numpy as np


def seed_for(name: str, *keys: int) -> int:
    """A 63-bit seed that depends only on ``name`` and ``keys``.

    Different names give unrelated seeds. So random streams are independent, and adding a stream does not change the
    others.
    """
    text = "/".join([name, *map(str, keys)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def generator(name: str, *keys: int) -> np.random.Generator:
    """A NumPy generator seeded by :func:`seed_for`."""
    return np.random.default_rng(seed_for(name, *keys))
