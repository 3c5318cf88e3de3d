"""Prioritized experience replay (Schaul et al. 2016) of executed picks."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

COLUMNS = ("color", "height", "angle", "row", "col", "label", "priority")


class Replay:
    """Every attempt with the heightmap it was decided on.

    Sampling: P(i) = p_i^alpha / sum p^alpha with p = |prediction - label| + floor at the executed pixel, new
    attempts at the largest priority so far; importance weights (n P(i))^-beta, scaled to a maximum of 1.

    Args:
        alpha: How much priorities count; 0 samples uniformly.
        beta: How much the bias is corrected.
        floor: Smallest priority.
        rng: Generator of the draws.
    """

    def __init__(self, alpha: float, beta: float, floor: float, rng: np.random.Generator):
        self._alpha, self._beta, self._floor = alpha, beta, floor
        self._rng = rng
        self._items: dict[str, list] = {name: [] for name in COLUMNS}
        self._drawn = np.array([], dtype=int)

    def __len__(self) -> int:
        return len(self._items["label"])

    def add(
        self, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"], angle: int, row: int, col: int, success: bool
    ) -> None:
        """Remember an attempt."""
        priority = max(self._items["priority"], default=1.0)
        values = (color, height, angle, row, col, float(success), priority)
        for name, value in zip(COLUMNS, values, strict=True):
            self._items[name].append(value)

    def sample(self, size: int) -> dict[str, Tensor]:
        """A batch, the newest attempt always in it: color (B, H, W, 3) uint8, height (B, H, W) float32, angle, row,
        col int64, label and weight float32."""
        scaled = np.array(self._items["priority"]) ** self._alpha
        probability = scaled / scaled.sum()
        drawn = self._rng.choice(len(self), size, p=probability)
        drawn[0] = len(self) - 1
        self._drawn = drawn
        weight = (len(self) * probability[drawn]) ** -self._beta
        columns = {name: [self._items[name][i] for i in drawn] for name in COLUMNS}
        return {
            "color": torch.from_numpy(np.stack(columns["color"])),
            "height": torch.from_numpy(np.stack(columns["height"])),
            **{name: torch.tensor(columns[name]) for name in ("angle", "row", "col", "label")},
            "weight": torch.tensor(weight / weight.max(), dtype=torch.float32),
        }

    def update(self, surprise: Float[np.ndarray, " B"]) -> None:
        """New |prediction - label| for the batch drawn last."""
        for i, value in zip(self._drawn, surprise, strict=True):
            self._items["priority"][i] = float(value) + self._floor

    def state_dict(self) -> dict:
        """Tensors and plain containers only, so that a checkpoint loads with ``weights_only``."""
        state: dict = {name: list(self._items[name]) for name in COLUMNS}
        if len(self):
            for name in ("color", "height"):
                state[name] = torch.from_numpy(np.stack(self._items[name]))
        state["rng"] = self._rng.bit_generator.state
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._items = {name: list(state[name]) for name in COLUMNS}
        for name in ("color", "height"):
            self._items[name] = [value.numpy() for value in state[name]]
        self._rng.bit_generator.state = state["rng"]
