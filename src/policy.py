"""From affordances to a pick: the same rule for every arm of a comparison."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats
from scipy.special import expit

from see2act.errors import DivergedError
from see2act.robot.types import Heightmap


@dataclass(frozen=True)
class Choice:
    """An angle's index and a pixel, with the logit that won."""

    angle: int
    row: int
    col: int
    logit: float
    explored: bool
    entropy: float = 0.0
    """Nats of the distribution that it was drawn from; 0 where the best was taken."""

    @property
    def score(self) -> float:
        """Predicted probability of success."""
        return float(expit(self.logit))


@dataclass
class _Failure:
    choice: Choice
    height: np.ndarray
    """The patch of the heightmap around the pixel, as it was."""


@dataclass
class Policy:
    """Picks the best pixel; what just failed is left alone while the scene there is unchanged.

    A deterministic argmax repeats a failed pick for ever if the pick changed nothing. With ``suppress`` a small
    neighbourhood of each failed pick is left out until the heights around it change or something is picked.

    Args:
        name: ``suppress`` or ``argmax``.
        suppress: Whether failures are remembered at all.
        pixel: Metres a pixel of the heightmap.
        radius: Metres around a failed pick that are left out.
        angles: Neighbouring angles (to each side, of the robot's 16) that are left out with it.
        changed_height: Metres by which a cell must change to count as changed.
        changed_share: Share of changed cells around the pick that makes the scene there a new one.
        changed_radius: Metres around the pick that are compared.
        footprint: Metres from the middle of the tool to its outer ends, along the jaws and across them: all of it must have
            room between the bin's walls (the paper plans motions free of collisions with what is known).
    """

    name: str
    suppress: bool
    pixel: float
    radius: float = 0.01
    angles: int = 2
    changed_height: float = 0.008
    changed_share: float = 0.1
    changed_radius: float = 0.03
    footprint: tuple[float, float] = (0.0, 0.0)
    _failures: list[_Failure] = field(default_factory=list)

    def plain(self) -> Policy:
        """The plain argmax rule, without memory."""
        return replace(self, name="argmax", suppress=False, _failures=[])

    def fresh(self) -> Policy:
        """The same rule with an empty memory."""
        return replace(self, _failures=[])

    def choose(
        self,
        logits: Float[np.ndarray, "A H W"],
        heightmap: Heightmap,
        temperature: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> Choice:
        """The best allowed pixel, or with a ``temperature`` one drawn from the softmax of scores / temperature.

        Scores, not logits: where the model expects success somewhere the draw is close to the best, and where it
        expects failure everywhere the draw is close to uniform, so that a model which has met nothing but failure
        looks elsewhere.

        Raises:
            DivergedError: A logit is not finite.
        """
        if not np.isfinite(logits).all():
            raise DivergedError("affordances are not finite")
        allowed = self._allowed(logits.shape, heightmap)
        masked = np.where(allowed, logits, -np.inf)
        best = int(masked.argmax())
        index, entropy = best, 0.0
        if temperature > 0:
            assert rng is not None, "exploring needs a generator"
            scores = np.where(allowed, expit(logits.astype(np.float64)), -np.inf).ravel()
            weights = np.exp((scores - scores.max()) / temperature)
            cumulative = np.cumsum(weights)
            index = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
            entropy = float(stats.entropy(weights))
        angle, row, col = (int(i) for i in np.unravel_index(index, logits.shape))
        return Choice(angle, row, col, float(logits[angle, row, col]), index != best, entropy)

    def remember(self, choice: Choice, heightmap: Heightmap, success: bool) -> None:
        """Take note of an attempt that was decided on ``heightmap``."""
        if success:
            self._failures.clear()
        elif self.suppress:
            self._failures.append(_Failure(choice, self._patch(heightmap, choice).copy()))

    def forget(self) -> None:
        """A new scene."""
        self._failures.clear()

    def _allowed(self, shape: tuple[int, ...], heightmap: Heightmap) -> np.ndarray:
        self._failures = [f for f in self._failures if not self._changed(f, heightmap)]
        room = room_between_walls(shape, self.footprint, self.pixel)
        allowed = room.copy()
        v, u = np.ogrid[: shape[1], : shape[2]]
        for failure in self._failures:
            c = failure.choice
            near = (v - c.row) ** 2 + (u - c.col) ** 2 <= (self.radius / self.pixel) ** 2
            beside = [(c.angle + k) % shape[0] for k in range(-self.angles, self.angles + 1)]
            for angle in set(beside):
                allowed[angle] &= ~near
        return allowed if allowed.any() else room

    def _changed(self, failure: _Failure, heightmap: Heightmap) -> bool:
        difference = np.abs(self._patch(heightmap, failure.choice) - failure.height)
        return bool((difference > self.changed_height).mean() > self.changed_share)

    def _patch(self, heightmap: Heightmap, choice: Choice) -> np.ndarray:
        r = round(self.changed_radius / self.pixel)
        rows = slice(max(0, choice.row - r), choice.row + r + 1)
        cols = slice(max(0, choice.col - r), choice.col + r + 1)
        return heightmap.height[rows, cols]


def room_between_walls(shape: tuple[int, ...], footprint: tuple[float, float], pixel: float) -> Bool[np.ndarray, "A H W"]:
    """Where a tool, turned by each angle, stays within the heightmap: its border is where the walls stand.

    Args:
        shape: Angles (over half a turn), rows and columns.
        footprint, pixel: As of :class:`Policy`.
    """
    angles, rows, cols = shape
    room = np.zeros(shape, bool)
    along, across = (metres / pixel for metres in footprint)
    for k in range(angles):
        cosine, sine = abs(math.cos(k * math.pi / angles)), abs(math.sin(k * math.pi / angles))
        top, left = (
            max(0, math.ceil(reach - 0.5 - 1e-6))  # a pixel's middle is at its index and a half
            for reach in (along * sine + across * cosine, along * cosine + across * sine)
        )
        room[k, top : rows - top, left : cols - left] = True
    return room
