"""How often intervals over seeds contain what they estimate, and how often equal groups are called different: by simulation.

Success of a seed is a vision model's part plus the seed's own part, both normal, with a standard deviation of 1 together.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.common import at_least_one, finish
from see2act.analysis.contrasts import verdict
from see2act.analysis.intervals import improvement_interval, mean_difference_interval, t_interval
from see2act.analysis.reaching import Reaching
from see2act.seeding import generator

SEEDS = 10
MODELS = 3
SHARES = (0.25, 0.8)
"""Of the variance: what vision models cause."""
RESAMPLES = 1000
NOT_REACHED = 100.0
"""Attempts after which a simulated run is not tested any more."""
Interval = tuple[float, float]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    parser.add_argument("--draws", type=at_least_one, default=2000, metavar="N", help="simulated groups of runs (default 2000)")
    args = parser.parse_args()
    rows = [_coverage(name, interval, models, share, args.draws) for name, interval, models in INTERVALS for share in SHARES]
    rows += [_of_medians(args.draws), _of_equal_groups(args.draws)]
    finish("Intervals over seeds", rows, args.json)


def _coverage(name: str, interval: Callable[..., Interval], models: int, share: float, draws: int) -> dict[str, Any]:
    """How often the interval of a group of runs contains the mean, which is 0."""
    rng = generator("simulated intervals")
    of_seed = np.arange(SEEDS) % models
    limits = np.array([interval(_scores(of_seed, share, rng), of_seed, rng) for _ in range(draws)])
    contained = float(np.mean((limits[:, 0] <= 0) & (limits[:, 1] >= 0)))
    width = float(np.median(limits[:, 1] - limits[:, 0]))
    return _row(name, f"{models} models, which cause {share:g} of the variance", contained, width)


def _row(name: str, of: str, share: float, width: float | None = None) -> dict[str, Any]:
    return {"interval": name, "of": of, "share": share, "median width": "" if width is None else width}


def _scores(of_seed: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    models = rng.normal(0, np.sqrt(share), of_seed.max() + 1)
    scores: np.ndarray = models[of_seed] + rng.normal(0, np.sqrt(1 - share), len(of_seed))
    return scores


def _by_model(scores: np.ndarray, of_seed: np.ndarray) -> list[np.ndarray]:
    return [scores[of_seed == k] for k in np.unique(of_seed)]


def _t_over_seeds(scores: np.ndarray, of_seed: np.ndarray, rng: np.random.Generator) -> Interval:
    interval = t_interval(scores.tolist())
    assert interval is not None
    return interval


def _t_over_models(scores: np.ndarray, of_seed: np.ndarray, rng: np.random.Generator) -> Interval:
    return _t_over_seeds(np.array([group.mean() for group in _by_model(scores, of_seed)]), of_seed, rng)


def _bootstrap(scores: np.ndarray, of_seed: np.ndarray, rng: np.random.Generator) -> Interval:
    """Models are drawn with replacement, and within each the seeds that have it."""
    groups = _by_model(scores, of_seed)
    sums, counts = np.zeros(RESAMPLES), np.zeros(RESAMPLES)
    drawn = rng.integers(len(groups), size=(RESAMPLES, len(groups)))
    for column in drawn.T:
        for k, group in enumerate(groups):
            chosen = column == k
            sums[chosen] += group[rng.integers(len(group), size=(chosen.sum(), len(group)))].sum(axis=1)
            counts[chosen] += len(group)
    low, high = np.percentile(sums / counts, [2.5, 97.5])
    return float(low), float(high)


def _components(scores: np.ndarray, of_seed: np.ndarray, rng: np.random.Generator) -> Interval:
    """Variance components of a one-way random effects model (analysis of variance), with Satterthwaite's degrees of freedom."""
    groups = _by_model(scores, of_seed)
    sizes = np.array([len(group) for group in groups])
    total, between_df, within_df = sizes.sum(), len(groups) - 1, sizes.sum() - len(groups)
    means = np.array([group.mean() for group in groups])
    between = float((sizes * (means - scores.mean()) ** 2).sum()) / between_df
    within = float(sum(((group - group.mean()) ** 2).sum() for group in groups)) / within_df
    size = (total - (sizes**2).sum() / total) / between_df
    weight = float((sizes**2).sum()) / total**2 / size
    parts = np.array([weight * between, (1 / total - weight) * within])
    variance = max(parts.sum(), 1e-12)
    df = variance**2 / float((parts**2 / (between_df, within_df)).sum())
    reach = stats.t.ppf(0.975, df) * np.sqrt(variance)
    return float(scores.mean() - reach), float(scores.mean() + reach)


INTERVALS: tuple[tuple[str, Callable[..., Interval], int], ...] = (
    ("hierarchical bootstrap", _bootstrap, MODELS),
    ("variance components", _components, MODELS),
    ("t interval of the models' means", _t_over_models, MODELS),
    ("t interval over seeds", _t_over_seeds, SEEDS),
)


def _of_medians(draws: int) -> dict[str, Any]:
    """Of attempts until a target: exponential, and not reached by a quarter of the runs."""
    rng, scale = generator("simulated medians"), 50.0
    attempts = rng.exponential(scale, size=(draws, SEEDS))
    attempts[attempts > NOT_REACHED] = np.inf
    limits = [Reaching(tuple(row), int(NOT_REACHED)).interval or (np.nan, np.nan) for row in attempts]
    contained = float(np.mean([low <= scale * np.log(2) <= high for low, high in limits]))
    return _row("exact interval of the median", f"{SEEDS} seeds' attempts until a target", contained)


def _of_equal_groups(draws: int) -> dict[str, Any]:
    """How often two equal groups of five are called better or worse."""
    rng = generator("simulated verdicts")
    told = 0
    for a, b in rng.normal(size=(draws, 2, 5)):
        difference = mean_difference_interval(a.tolist(), b.tolist())
        assert difference is not None
        told += verdict(5, 5, improvement_interval(a, b), difference) in ("better", "worse")
    return _row("called better or worse", "two equal groups of five seeds", told / draws)


if __name__ == "__main__":
    main()
