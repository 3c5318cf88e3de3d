"""From affordances to a pick. All conditions of a comparison use the same rule."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float
from scipy import stats
from scipy.special import expit

from see2act.errors import DivergedError
from see2act.robot.types import Heightmap, NotNegative


@dataclass(frozen=True)
class Choice:
    """A chosen angle index and pixel, with their logit."""

    angle: int
    row: int
    col: int
    logit: float
    explored: bool
    entropy: float = 0.0
    """Entropy in nats of the distribution that the choice was drawn from; 0 if the best pixel was taken."""

    @property
    def score(self) -> float:
        """Predicted probability of success."""
        return float(expit(self.logit))


@dataclass
class _Failure:
    choice: Choice
    height: np.ndarray
    """Heights around the pixel at the time of the failed pick."""


@dataclass
class Policy:
    """Picks the best pixel, but avoids a pixel that has failed as long as the scene there is unchanged.

    A deterministic argmax repeats a failed pick forever if the pick changed nothing. With ``suppress`` the policy avoids the
    neighbourhood of each failed pick until the heights around it change, or until a pick succeeds.

    Args:
        name: ``suppress`` or ``argmax``.
        suppress: Whether failures are remembered at all.
        pixel: Metres per pixel of the heightmap.
        radius: Radius around a failed pick that is avoided, metres.
        until_success: Forget all failed picks when a pick succeeds. Fingers that fail have often moved the object a little.
        angles: Number of neighbouring angles to each side (of the robot's 16) that are avoided too.
        changed_height: Height difference above which a cell counts as changed, metres.
        changed_share: Share of changed cells around the pick above which the scene there counts as changed.
        changed_radius: Distance from the pick within which heights are compared, metres.
        footprint: Metres from the middle of the tool to its outer ends, along the jaws and across them. The whole tool must
            have room between the bin's walls. (The paper plans motions that avoid collisions with what is known.)
    """

    name: str
    suppress: bool
    pixel: float
    radius: NotNegative = 0.01
    until_success: bool = False
    angles: Annotated[int, Ge(0)] = 2
    changed_height: NotNegative = 0.008
    changed_share: NotNegative = 0.1
    changed_radius: NotNegative = 0.03
    footprint: tuple[float, float] = (0.0, 0.0)
    _failures: list[_Failure] = field(default_factory=list)

    def plain(self) -> Policy:
        """This policy as a plain argmax without memory."""
        return replace(self, name="argmax", suppress=False, _failures=[])

    def fresh(self) -> Policy:
        """This policy with an empty memory."""
        return replace(self, _failures=[])

    def choose(
        self,
        logits: Float[np.ndarray, "A H W"],
        heightmap: Heightmap,
        temperature: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> Choice:
        """The best allowed pixel, or with a ``temperature`` one drawn from the softmax of scores / temperature.

        The softmax is over scores, not logits. If the model expects success somewhere, the draw is close to the best pixel. If
        it expects failure everywhere, the draw is close to uniform, so a model that has only seen failures tries other places.

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
        """Remember the outcome of an attempt that was chosen on ``heightmap``."""
        if success and self.until_success:
            self._failures.clear()
        elif self.suppress and not success:
            self._failures.append(_Failure(choice, self._patch(heightmap, choice).copy()))

    def forget(self) -> None:
        """Clear the memory at the start of a new scene."""
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
    """Where the tool, rotated by each angle, stays within the heightmap. The walls stand at the heightmap's border.

    Args:
        shape: Number of angles (over half a turn), rows and columns.
        footprint, pixel: As for :class:`Policy`.
    """
    angles, rows, cols = shape
    room = np.zeros(shape, bool)
    along, across = (metres / pixel for metres in footprint)
    for k in range(angles):
        cosine, sine = abs(math.cos(k * math.pi / angles)), abs(math.sin(k * math.pi / angles))
        top, left = (
            max(0, math.ceil(reach - 0.5 - 1e-6))  # the centre of a pixel is at its index plus 0.5
            for reach in (along * sine + across * cosine, along * cosine + across * sine)
        )
        room[k, top : rows - top, left : cols - left] = True
    return room
