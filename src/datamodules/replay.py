"""Prioritized experience replay (Schaul et al. 2016) of executed picks."""

from __future__ import annotations

import math
import zlib
from array import array
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from see2act.errors import DivergedError
from see2act.modules.affordance import AttemptBatch, Augmentation
from see2act.modules.color_jitter import random_mixtures

COLUMNS = ("angle", "row", "col", "label")
HEIGHT_STEP = 1e-4
"""Metres: heights are stored as multiples of this. The sensor's noise is about ten times as large."""


class Replay:
    """Every attempt with the heightmap it was decided on, compressed: about 19 kB for 144 x 144 px, 104 kB at most.

    Sampling: P(i) = p_i^alpha / sum p^alpha with p = |TD error| + floor, where the TD error of a one-step task is the
    prediction less the label at the executed pixel. New attempts get the largest priority so far. Importance weights are
    (n P(i))^-beta, scaled to a maximum of 1. The newest attempt is in every batch, as in combined experience replay (Zhang and
    Sutton 2017).

    Args:
        alpha: How much priorities count; 0 samples uniformly.
        beta: How much the bias is corrected.
        floor: Smallest priority.
        mirror: Whether half of the heightmaps are mirrored by rows, and half by columns. A cup does not mind, and a grasp that
            is horizontal in the rotated heightmap stays so.
        rotation: Radians up to which heightmaps are rotated about their pixel, either way.
        shift: Metres up to which they are shifted, along rows and columns, either way.
        color_jitter: Share by which colour channels, in any order, become stronger or weaker, lighter or darker. Whether a
            tool holds depends on shape, not on colour.
        pixel: Metres per pixel.
        rng: Generator of the draws.
    """

    def __init__(
        self,
        *,
        alpha: float,
        beta: float,
        floor: float,
        mirror: bool,
        rotation: float,
        shift: float,
        color_jitter: float,
        pixel: float,
        rng: np.random.Generator,
    ):
        self._alpha, self._beta, self._floor = alpha, beta, floor
        self._mirror, self._rotation, self._shift, self._color_jitter = mirror, rotation, shift / pixel, color_jitter
        self._rng = rng
        self._items: dict[str, list] = {name: [] for name in COLUMNS}
        self._heightmaps: list[bytes] = []
        self._shape: tuple[int, ...] = (0, 0)
        self._priorities = array("d")
        self._scaled = array("d")
        """Priorities to the power of alpha."""

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
        self._prioritize(len(self) - 1, float(np.max(self._priorities, initial=0.0)) or 1.0)

    def sample(self, size: int) -> AttemptBatch:
        """A batch of attempts with random augmentation, the newest attempt first.

        Raises:
            DivergedError: Priorities are not finite and positive.
        """
        scaled = np.frombuffer(self._scaled)
        cumulative = np.cumsum(scaled)
        total = cumulative[-1]
        if not 0 < total < np.inf:
            raise DivergedError("replay priorities are not finite and positive")
        index = np.searchsorted(cumulative, self._rng.random(size) * total, side="right").clip(max=len(self) - 1)
        index[0] = len(self) - 1
        weight = (len(self) * scaled[index] / total) ** -self._beta
        color, height = zip(*(_unpacked(self._heightmaps[i], self._shape) for i in index), strict=True)
        return AttemptBatch(
            color=torch.from_numpy(np.stack(color)),
            height=torch.from_numpy(np.stack(height)),
            **{name: torch.tensor([self._items[name][i] for i in index]) for name in COLUMNS},
            weight=torch.tensor(weight / weight.max(), dtype=torch.float32),
            replay_index=torch.from_numpy(index),
            augmentation=self._augmentation(size),
        )

    def update(self, index: Int[np.ndarray, " B"], td_error: Float[np.ndarray, " B"]) -> None:
        """New priorities for the attempts of a batch, from |prediction - label|."""
        for i, error in zip(index, td_error, strict=True):
            self._prioritize(i, float(error) + self._floor)

    def statistics(self, index: Int[np.ndarray, " B"]) -> dict[str, float]:
        """Of the attempts of a batch: mean age in attempts, mean priority, and share of successes."""
        return {
            "age": float(len(self) - 1 - index.mean()),
            "priority": float(np.mean([self._priorities[i] for i in index])),
            "successes": float(np.mean([self._items["label"][i] for i in index])),
        }

    def success(self, last: int) -> float:
        """Success rate of the ``last`` attempts that were added, or of all if there are fewer."""
        return float(np.mean(self._items["label"][-last:]))

    def state_dict(self) -> dict:
        """Tensors and plain containers only, so that a checkpoint loads with ``weights_only``."""
        state: dict = {name: list(self._items[name]) for name in COLUMNS}
        state["heightmaps"] = torch.from_numpy(np.frombuffer(b"".join(self._heightmaps), np.uint8).copy())
        state["sizes"] = [len(packed) for packed in self._heightmaps]
        state["shape"] = list(self._shape)
        state["priority"] = torch.tensor(list(self._priorities), dtype=torch.float64)
        state["rng"] = self._rng.bit_generator.state
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._items = {name: list(state[name]) for name in COLUMNS}
        packed, ends = state["heightmaps"].numpy().tobytes(), np.cumsum([0, *state["sizes"]])
        self._heightmaps = [packed[a:b] for a, b in pairwise(ends)]
        self._shape = tuple(state["shape"])
        self._priorities, self._scaled = array("d"), array("d")
        for i, priority in enumerate(state["priority"].tolist()):
            self._prioritize(i, priority)
        self._rng.bit_generator.state = state["rng"]

    def _prioritize(self, i: int, priority: float) -> None:
        if i == len(self._priorities):
            self._priorities.append(0.0)
            self._scaled.append(0.0)
        self._priorities[i], self._scaled[i] = priority, priority**self._alpha

    def _augmentation(self, size: int) -> Augmentation:
        rng = self._rng
        return Augmentation(
            mirror=torch.from_numpy((rng.random((size, 2)) < 0.5) & self._mirror),
            rotation=torch.from_numpy(rng.uniform(-self._rotation, self._rotation, size).astype(np.float32)),
            shift=torch.from_numpy(rng.uniform(-self._shift, self._shift, (size, 2)).astype(np.float32)),
            mixtures=random_mixtures(size, self._color_jitter, torch.Generator().manual_seed(int(rng.integers(2**63)))),
        )


def _packed(color: np.ndarray, height: np.ndarray) -> bytes:
    steps = np.rint(height / HEIGHT_STEP).astype(np.int16)
    return zlib.compress(color.tobytes() + steps.tobytes(), level=1)


def _unpacked(packed: bytes, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    data = zlib.decompress(packed)
    color = np.frombuffer(data, np.uint8, 3 * math.prod(shape)).reshape(*shape, 3)
    steps = np.frombuffer(data, np.int16, offset=color.size).reshape(shape)
    return color, steps * np.float32(HEIGHT_STEP)
