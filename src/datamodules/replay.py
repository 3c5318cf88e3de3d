"""Prioritized experience replay (Schaul et al. 2016) of executed picks."""

from __future__ import annotations

import math
import zlib
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from see2act.errors import DivergedError
from see2act.modules.tint import tints

COLUMNS = ("angle", "row", "col", "label")
HEIGHT_STEP = 1e-4
"""Metres to which heights are kept; the sensor's noise is about ten times that."""
BLOCK = 1024
"""Priorities summed together, so that a draw looks at one sum a block and then into one block."""


class Replay:
    """Every attempt with the heightmap it was decided on, compressed: some 19 kB for 144 x 144 px, 104 kB at the worst.

    Sampling: P(i) = p_i^alpha / sum p^alpha with p = |prediction - label| + floor at the executed pixel, new
    attempts at the largest priority so far; importance weights (n P(i))^-beta, scaled to a maximum of 1.

    Args:
        alpha: How much priorities count; 0 samples uniformly.
        beta: How much the bias is corrected.
        floor: Smallest priority.
        mirror: Whether half of the heightmaps, drawn anew each time, are to be mirrored by rows, and half by columns:
            a cup does not mind, and a grasp that is horizontal in the turned heightmap stays so.
        turn: Radians up to which heightmaps are to be turned about their pixel, either way.
        shift: Metres up to which they are to be shifted, along rows and columns, either way.
        tint: Share by which the colour channels, in any order, are to be made stronger and lighter: what an object is to a tool
            is its shape.
        pixel: Metres a pixel.
        rng: Generator of the draws.
    """

    def __init__(
        self,
        alpha: float,
        beta: float,
        floor: float,
        mirror: bool,
        turn: float,
        shift: float,
        tint: float,
        pixel: float,
        rng: np.random.Generator,
    ):
        self._beta, self._floor = beta, floor
        self._mirror, self._turn, self._shift, self._tint = mirror, turn, shift / pixel, tint
        self._rng = rng
        self._items: dict[str, list] = {name: [] for name in COLUMNS}
        self._heightmaps: list[bytes] = []
        self._shape: tuple[int, ...] = (0, 0)
        self._priorities = _Priorities(alpha)
        self._drawn = np.array([], dtype=int)

    def __len__(self) -> int:
        return len(self._items["label"])

    def add(
        self, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"], angle: int, row: int, col: int, success: bool
    ) -> None:
        """Remember an attempt."""
        self._shape = height.shape
        self._heightmaps.append(_packed(color, height))
        for name, value in zip(COLUMNS, (angle, row, col, float(success)), strict=True):
            self._items[name].append(value)
        self._priorities.append(self._priorities.largest())

    def sample(self, size: int) -> dict[str, Tensor]:
        """A batch, the newest attempt always in it: color (B, H, W, 3) uint8, height (B, H, W) float32, angle, row,
        col int64, label and weight float32, mirror (B, 2) bool, turn (B,), shift (B, 2) and tint (B, 3, 4) float32.

        Raises:
            DivergedError: Priorities are not finite and positive, since the network has diverged.
        """
        drawn = self._priorities.draw(size, self._rng)
        drawn[0] = len(self) - 1
        self._drawn = drawn
        weight = (len(self) * self._priorities.probability(drawn)) ** -self._beta
        color, height = zip(*(_unpacked(self._heightmaps[i], self._shape) for i in drawn), strict=True)
        return {
            "color": torch.from_numpy(np.stack(color)),
            "height": torch.from_numpy(np.stack(height)),
            **{name: torch.tensor([self._items[name][i] for i in drawn]) for name in COLUMNS},
            "weight": torch.tensor(weight / weight.max(), dtype=torch.float32),
            "mirror": torch.from_numpy((self._rng.random((size, 2)) < 0.5) & self._mirror),
            "turn": torch.from_numpy(self._rng.uniform(-self._turn, self._turn, size).astype(np.float32)),
            "shift": torch.from_numpy(self._rng.uniform(-self._shift, self._shift, (size, 2)).astype(np.float32)),
            "tint": tints(size, self._tint, torch.Generator().manual_seed(int(self._rng.integers(2**63)))),
        }

    def update(self, surprise: Float[np.ndarray, " B"]) -> None:
        """New |prediction - label| for the batch drawn last."""
        for i, value in zip(self._drawn, surprise, strict=True):
            self._priorities[i] = float(value) + self._floor

    def last_draw(self) -> dict[str, float]:
        """Of the batch drawn last: mean age in attempts, mean priority, and share of successes."""
        return {
            "age": float(len(self) - 1 - self._drawn.mean()),
            "priority": float(self._priorities.values()[self._drawn].mean()),
            "successes": float(np.mean([self._items["label"][i] for i in self._drawn])),
        }

    def success(self, last: int) -> float:
        """Share of successes among the ``last`` attempts that were added, or among all if there are fewer."""
        return float(np.mean(self._items["label"][-last:]))

    def state_dict(self) -> dict:
        """Tensors and plain containers only, so that a checkpoint loads with ``weights_only``."""
        state: dict = {name: list(self._items[name]) for name in COLUMNS}
        state["heightmaps"] = torch.from_numpy(np.frombuffer(b"".join(self._heightmaps), np.uint8).copy())
        state["sizes"] = [len(packed) for packed in self._heightmaps]
        state["shape"] = list(self._shape)
        state["priority"] = torch.from_numpy(self._priorities.values())
        state["rng"] = self._rng.bit_generator.state
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._items = {name: list(state[name]) for name in COLUMNS}
        packed, ends = state["heightmaps"].numpy().tobytes(), np.cumsum([0, *state["sizes"]])
        self._heightmaps = [packed[a:b] for a, b in pairwise(ends)]
        self._shape = tuple(state["shape"])
        self._priorities = _Priorities(self._priorities.alpha)
        for value in state["priority"].tolist():
            self._priorities.append(value)
        self._rng.bit_generator.state = state["rng"]


def _packed(color: np.ndarray, height: np.ndarray) -> bytes:
    steps = np.rint(height / HEIGHT_STEP).astype(np.int16)
    return zlib.compress(color.tobytes() + steps.tobytes(), level=1)


def _unpacked(packed: bytes, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    data = zlib.decompress(packed)
    color = np.frombuffer(data, np.uint8, 3 * math.prod(shape)).reshape(*shape, 3)
    steps = np.frombuffer(data, np.int16, offset=color.size).reshape(shape)
    return color, steps * np.float32(HEIGHT_STEP)


class _Priorities:
    """Priorities p_i that are drawn from with P(i) = p_i^alpha / sum p^alpha, at a cost that hardly grows with their number."""

    def __init__(self, alpha: float):
        self.alpha = alpha
        self._count = 0
        self._priority = np.zeros(BLOCK)
        self._scaled = np.zeros(BLOCK)
        self._sums = np.zeros(1)

    def values(self) -> Float[np.ndarray, " n"]:
        """All of them."""
        return self._priority[: self._count].copy()

    def largest(self) -> float:
        """The largest one; 1 where there is none."""
        return float(self._priority[: self._count].max()) if self._count else 1.0

    def append(self, value: float) -> None:
        """One more."""
        if self._count == len(self._priority):
            self._priority, self._scaled, self._sums = (
                np.concatenate([array, np.zeros_like(array)]) for array in (self._priority, self._scaled, self._sums)
            )
        self._count += 1
        self[self._count - 1] = value

    def __setitem__(self, i: int, value: float) -> None:
        self._priority[i] = value
        self._scaled[i] = value**self.alpha
        block = i // BLOCK
        self._sums[block] = self._scaled[block * BLOCK : (block + 1) * BLOCK].sum()

    def probability(self, index: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Of drawing each."""
        return self._scaled[index] / self._sums.sum()

    def draw(self, size: int, rng: np.random.Generator) -> Int[np.ndarray, " size"]:
        """Indices, with replacement."""
        upto = np.cumsum(self._sums)
        if not 0 < upto[-1] < np.inf:
            raise DivergedError("replay priorities are not finite and positive")
        target = rng.random(size) * upto[-1]
        blocks = np.searchsorted(upto, target, side="right").clip(0, (self._count - 1) // BLOCK)
        drawn = np.empty(size, int)
        for k, block in enumerate(blocks):
            start = block * BLOCK
            within = np.cumsum(self._scaled[start : min(start + BLOCK, self._count)])
            left = target[k] - (upto[block] - self._sums[block])
            drawn[k] = start + min(int(np.searchsorted(within, left, side="right")), len(within) - 1)
        return drawn
