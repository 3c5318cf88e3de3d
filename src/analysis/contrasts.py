"""What may be concluded from two groups, and from several together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from see2act.analysis.groups import ENOUGH, Comparison, Group
from see2act.analysis.intervals import (
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    mean_difference_interval,
)
from see2act.analysis.summary import LEARNING, number_text, rates, scores_of


@dataclass(frozen=True)
class Contrast:
    """How probably a seed of one group does better than one of another; numbers are empty below ``ENOUGH`` seeds of either."""

    group: Group
    other: Group
    measure: str
    verdict: str
    probability: str
    low: str
    high: str
    difference: str
    """Of the means."""
    difference_low: str
    difference_high: str


def contrasts(comparison: Comparison, measure: str) -> list[Contrast]:
    """Every group with the baseline, and groups of one source with each other."""
    pairs = [
        (group, other)
        for i, group in enumerate(comparison.groups)
        for other in comparison.groups[:i]
        if other.transfer == "none" or group.task == other.task
    ]
    found = []
    for group, other in pairs:
        a, b = (rates(each, measure) for each in (group, other))
        if a and b:
            told, numbers = compared(a, b)
            found.append(Contrast(group, other, measure, told, *map(number_text, numbers)))
    return found


def compared(a: Sequence[float], b: Sequence[float]) -> tuple[str, tuple[float | None, ...]]:
    """What the rates of the seeds of one group allow to say against those of another.

    Returns:
        The verdict, and the numbers of a :class:`Contrast` in its order, each None below ``ENOUGH`` seeds of either.
    """
    left, right = np.array(a), np.array(b)
    low, high = improvement_interval(left, right)
    limits = mean_difference_interval(a, b)
    numbers: tuple[float | None, ...] = (None,) * 6
    if limits and min(len(a), len(b)) >= ENOUGH:
        numbers = (float(improvement(left, right)), low, high, float(left.mean() - right.mean()), *limits)
    return verdict(len(a), len(b), (low, high), limits or (-math.inf, math.inf)), numbers


WHEN = {LEARNING: "while learning", "after_unseen": "on unseen objects after fine-tuning"}


def findings(comparison: Comparison) -> list[str]:
    """A sentence for each contrast whose intervals allow a conclusion, and one for the others."""
    found = [contrast for measure in WHEN for contrast in contrasts(comparison, measure)]
    sentences = [
        f"{c.group.name} is {c.verdict} than {c.other.name} {WHEN[c.measure]}: success rate {float(c.difference):+.2f} "
        f"[{float(c.difference_low):+.2f}, {float(c.difference_high):+.2f}]."
        for c in found
        if c.verdict in ("better", "worse")
    ]
    few = sum(c.verdict.startswith("too few") for c in found)
    equal = len(found) - len(sentences) - few
    if equal:
        sentences.append(f"In {equal} of {len(found)} comparisons of two groups we found no significant difference.")
    if few:
        sentences.append(f"{few} of {len(found)} comparisons of two groups have too few seeds for a conclusion.")
    return sentences or ["There are no two groups to compare: the baseline is task=none transfer=none."]


def verdict(n: int, m: int, improvement: tuple[float, float], difference: tuple[float, float]) -> str:
    """What ``n`` seeds against ``m`` allow to say.

    A bootstrap of few seeds is too sure, so Welch's interval has to agree with it.

    Args:
        n, m: Seeds.
        improvement: Interval of the probability of improvement.
        difference: Interval of the difference of the means.
    """
    chance = 2 / math.comb(n + m, n)  # of the seeds of two equal groups to fall entirely apart, either way
    if min(n, m) < ENOUGH or chance > 0.05:
        odds = "always" if chance >= 1 else f"one time in {1 / chance:.0f}"
        return f"too few seeds to conclude ({n} and {m}): equal groups would separate completely {odds}"
    if improvement[0] > 0.5 and difference[0] > 0:
        return "better"
    if improvement[1] < 0.5 and difference[1] < 0:
        return "worse"
    return "no significant difference"


@dataclass(frozen=True)
class Aggregate:
    """The interquartile mean of several groups together."""

    transfer: str
    sources: str
    mean: str
    low: str
    high: str


def aggregates(comparison: Comparison) -> list[Aggregate]:
    """Every kind of transfer over its sources, on unseen objects; none where a source has several configurations."""
    kinds = {
        kind: [group for group in comparison.groups if group.transfer == kind]
        for kind in dict.fromkeys(a.transfer for a in comparison.groups)
    }
    if not all(group.alone for group in comparison.groups) or max(map(len, kinds.values())) < 2:
        return []
    together = []
    for kind, groups in kinds.items():
        strata = [scores_of(group) for group in groups]
        mean = float(interquartile_mean(np.concatenate([scores.ravel() for scores in strata])))
        interval = interquartile_interval(strata) if min(map(len, strata)) >= ENOUGH else (None, None)
        together.append(Aggregate(kind, ", ".join(group.task for group in groups), *map(number_text, (mean, *interval))))
    return together
