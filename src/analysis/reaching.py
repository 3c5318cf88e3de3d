"""How many attempts a group of runs needs until it picks unseen objects well: does learning to see speed up learning to act?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from see2act.analysis.groups import Group
from see2act.analysis.runs import Run

TARGET = 0.8
"""Success by the protocol on unseen objects. In the paper's simulation every source ends above it, and scratch below."""


@dataclass(frozen=True)
class Reaching:
    """Attempts until a test shows the target. A run that never shows it counts as infinitely many."""

    each: tuple[float, ...]
    """By seed, in the group's order."""
    last: int
    """Attempts after which the last test was made: nothing is known beyond."""

    @property
    def median(self) -> float:
        """Half of the seeds need no more."""
        return float(np.median(self.each))

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % interval of the median; None below six seeds, which are too few for one.

        It is exact: its limits are order statistics, so it assumes nothing of the distribution (Conover 1999, section 3.2).
        """
        limits = stats.quantile_test(self.each, p=0.5).confidence_interval(0.95)
        return None if math.isnan(limits.low) or math.isnan(limits.high) else (float(limits.low), float(limits.high))

    @property
    def reached(self) -> int:
        """Seeds that showed the target."""
        return sum(map(math.isfinite, self.each))

    def text(self, attempts: float) -> str:
        """A number of attempts as tables show it: ``> 300`` where the target was not reached in 300."""
        return f"{attempts:.0f}" if math.isfinite(attempts) else f"> {self.last}"


def reaching(group: Group) -> Reaching | None:
    """For a group that learned; None for one that did not."""
    if not group.learned:
        return None
    return Reaching(tuple(first_reached(run) for run in group.runs), min(run.result.evals[-1].step for run in group.runs))


def first_reached(run: Run, target: float = TARGET) -> float:
    """Attempts before the first test on unseen objects with at least the target; infinity if there is none."""
    return next((float(point.step) for point in run.result.evals if point.unseen.success_rate >= target), math.inf)


def tested_at(groups: Sequence[Group]) -> list[int]:
    """Numbers of attempts after which any run was tested."""
    return sorted({point.step for group in groups for run in group.runs for point in run.result.evals})
