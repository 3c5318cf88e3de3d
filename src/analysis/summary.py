"""The numbers of a report: a row for every group."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from see2act.analysis import paper
from see2act.analysis.commands import command_for
from see2act.analysis.groups import ENOUGH, Comparison, Found, Group
from see2act.analysis.intervals import (
    interquartile_interval,
    interquartile_mean,
    mean_interval,
    t_interval,
)
from see2act.analysis.reaching import reaching
from see2act.analysis.runs import Run
from see2act.experiment.results import SPLITS, wilson
from see2act.files import replacing
from see2act.robot.types import Split

MEASURES: dict[str, tuple[str, Split]] = {
    "after_unseen": ("eval", "unseen"),
    "after_seen": ("eval", "seen"),
    "zero_shot_unseen": ("zero_shot", "unseen"),
    "zero_shot_seen": ("zero_shot", "seen"),
    "argmax_unseen": ("eval_argmax", "unseen"),
    "argmax_seen": ("eval_argmax", "seen"),
}
"""Column to where ``result.json`` has it."""
LEARNING = "learning"
"""The measure of exploring attempts while fine-tuning."""
PARTS = ("mean", "low", "high", "successes", "attempts", "wilson_low", "wilson_high")
GAINS = {f"gain_{split}": (f"after_{split}", f"zero_shot_{split}") for split in ("unseen", "seen")}
"""What fine-tuning changed: a seed's rate after less its rate before, on the same scenes."""
GAIN_PARTS = ("mean", "low", "high", "lowest")
REACH = ("reach_median", "reach_low", "reach_high", "reach_seeds")
"""Attempts until success on unseen objects is ``reaching.TARGET``, and by how many seeds it was reached."""
IQM = ("after_unseen_iqm", "after_unseen_iqm_low", "after_unseen_iqm_high")
COLUMNS = (
    *("primitive", "protocol", "task", "transfer", "model", "config_hash", "differs", "seeds", "paper_unseen"),
    *(f"{measure}_{part}" for measure in (*MEASURES, LEARNING) for part in PARTS),
    *(f"{gain}_{part}" for gain in GAINS for part in GAIN_PARTS),
    *(*REACH, *IQM, "note"),
)
PROGRESS_COLUMNS = ("primitive", "protocol", "task", "transfer", "model", "config_hash", "seeds", "step", "split", *PARTS)
Row = dict[str, str]
"""Column to text, exactly as it is shown; empty where there is no number."""


def rates(group: Group, measure: str) -> list[float]:
    """Success rate of each seed, or of one where all seeds are one measurement; empty where a group has none."""
    return _rates(group.runs[:1] if one_measurement(group, measure) else group.runs, measure)


def one_measurement(group: Group, measure: str) -> bool:
    """Whether a group's seeds repeat each other: before it learns, nothing of a model whose head was copied is a seed's.

    Unless each seed has a vision model of its own. The configuration decides, not the scores: those of one model may differ
    by an attempt where seeds ran on different processors.
    """
    untouched = measure.startswith("zero_shot") or (not group.learned and measure != LEARNING)
    return len(group.runs) > 1 and untouched and group.transfer in ("full", "fixed") and len(group.pretrain_seeds) == 1


def scores_of(group: Group, measure: str = "after_unseen") -> np.ndarray:
    """Success rate (seed, test run); of one seed where all are one measurement."""
    runs = group.runs[:1] if one_measurement(group, measure) else group.runs
    return np.array([run.scores(*MEASURES[measure]) for run in runs])


def rows(found: Found) -> list[Row]:
    """A row for every group in the paper's order, and for every group of the paper that is missing."""
    present = [_row(comparison, group) for comparison in found.comparisons for group in comparison.groups]
    lines = [dict.fromkeys(COLUMNS, "") | row for row in [*present, *_missing(found)]]
    orders = [
        (name, list(dict.fromkeys([*order, *sorted(row[name] for row in lines)])))
        for name, order in (("primitive", paper.PRIMITIVES), ("task", paper.TASKS), ("transfer", paper.TRANSFERS))
    ]
    return sorted(lines, key=lambda row: [order.index(row[name]) for name, order in orders])


def progress(comparison: Comparison) -> list[Row]:
    """Success by the protocol on the way: a row for every group, split and step at which all its seeds were tested."""
    return [
        {**_identity(comparison, group), "step": str(step), "split": split, **_summed(counts)}
        for group in comparison.groups
        for (split, step), counts in tests(group).items()
    ]


def tests(group: Group) -> dict[tuple[str, int], list[tuple[int, int]]]:
    """Successes and attempts of each seed, or of one where all are one measurement, by split and attempts made before."""
    steps = [{point.step: point for point in run.result.evals} for run in group.runs]
    found: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for split in SPLITS:
        for step in sorted(set.intersection(*map(set, steps))):
            counts = [(at[step][split].successes, at[step][split].attempts) for at in steps]
            found[split, step] = counts[:1] if step == 0 and one_measurement(group, f"zero_shot_{split}") else counts
    return found


def _identity(comparison: Comparison, group: Group) -> Row:
    return {
        **{
            "primitive": comparison.primitive,
            "protocol": str(comparison.number or ""),
            "task": group.task,
            "transfer": group.transfer,
        },
        **{"model": comparison.protocol["model"], "config_hash": group.hash, "seeds": " ".join(map(str, group.seeds))},
    }


def _row(comparison: Comparison, group: Group) -> Row:
    row = {**_identity(comparison, group), "differs": group.differs, "paper_unseen": _rounded(published_for(comparison, group))}
    for measure in (*MEASURES, LEARNING):
        row |= {f"{measure}_{part}": text for part, text in _measured(group, measure).items()}
    if group.learned:
        known = {gain: pair for gain, pair in GAINS.items() if _rates(group.runs, pair[1])}
        row |= {f"{gain}_{part}": text for gain, pair in known.items() for part, text in _gained(group, *pair).items()}
    if found := reaching(group):
        texts = map(found.text, (found.median, *(found.interval or ())))
        row |= dict(zip(REACH, texts, strict=False)) | {"reach_seeds": str(found.reached)}
    scores = scores_of(group)
    interval = interquartile_interval([scores]) if len(scores) >= ENOUGH else (None, None)
    row |= dict(zip(IQM, map(number_text, (float(interquartile_mean(scores.ravel())), *interval)), strict=True))
    return row | {"note": "" if group.learned else "never fine-tuned"}


def _measured(group: Group, measure: str) -> Row:
    runs = group.runs[:1] if one_measurement(group, measure) else group.runs
    return _summed([_counts(run, measure) for run in runs]) if _rates(runs, measure) else {}


def pooled(counts: list[tuple[int, int]]) -> tuple[float, tuple[float, float] | None, int, int]:
    """Mean over seeds of their rates, its interval if they are enough, and the successes and attempts of all of them."""
    each = [successes / attempts for successes, attempts in counts]
    successes, attempts = (sum(column) for column in zip(*counts, strict=True))
    return float(np.mean(each)), mean_interval(each) if len(each) >= ENOUGH else None, successes, attempts


def _summed(counts: list[tuple[int, int]]) -> Row:
    """Successes and attempts of each seed as ``PARTS``."""
    mean, interval, successes, attempts = pooled(counts)
    numbers = (mean, *(interval or (None, None)), successes, attempts, *wilson(successes, attempts))
    return dict(zip(PARTS, map(number_text, numbers), strict=True))


def _gained(group: Group, after: str, before: str) -> Row:
    each = [a - b for a, b in zip(_rates(group.runs, after), _rates(group.runs, before), strict=True)]
    interval = t_interval(each) if len(each) >= ENOUGH else None
    numbers = (float(np.mean(each)), *(interval or (None, None)), min(each))
    return dict(zip(GAIN_PARTS, map(number_text, numbers), strict=True))


def _rates(runs: Sequence[Run], measure: str) -> list[float]:
    return [successes / attempts for successes, attempts in (_counts(run, measure) for run in runs) if attempts]


def _counts(run: Run, measure: str) -> tuple[int, int]:
    return run.learning if measure == LEARNING else run.counts(*MEASURES[measure])


def number_text(number: float | int | None) -> str:
    """As tables show it: a whole number, three decimals, or nothing for None."""
    if number is None:
        return ""
    return str(number) if isinstance(number, int) else f"{number:.3f}"


def published_for(comparison: Comparison, group: Group) -> float | None:
    """The paper's success on unseen objects, where its simulation is what this comparison imitates."""
    alike = comparison.protocol["model"] == "fcn7" and comparison.protocol["objects"] == "diverse"
    if not alike or not group.learned or group.transfer not in ("none", "full"):
        return None
    return paper.UNSEEN.get(comparison.primitive, {}).get(group.task)


def _rounded(published: float | None) -> str:
    return "" if published is None else f"{published:.2f}"


def _missing(found: Found) -> list[Row]:
    missing = []
    for primitive in paper.PRIMITIVES:
        comparisons = [comparison for comparison in found.comparisons if _same(comparison.primitive, primitive)]
        there = {(a.task, a.transfer, b.protocol["model"]) for b in comparisons for a in b.groups}
        for task, transfer, model in dict.fromkeys([*paper.expected(primitive), *_of_experiments(comparisons, primitive)]):
            if (task, transfer, model) in there:
                continue
            cell = (task, transfer, model)
            begun = sum((u.task, u.transfer, u.model) == cell and _same(u.primitive, primitive) for u in found.unfinished)
            reason = f"only unfinished runs ({begun})" if begun else "no runs"
            if file := paper.missing_weights(task, model):
                reason += f"; weights not here: {file}"
                if like := [
                    group for comparison in comparisons if comparison.protocol["model"] == model for group in comparison.groups
                ]:
                    reason += f", with which it is `{command_for(task, transfer, file, like[0])}`"
            number = paper.UNSEEN[primitive].get(task) if model == "fcn7" and transfer in ("none", "full") else None
            row = {"primitive": primitive, "task": task, "transfer": transfer, "model": model, "note": reason}
            missing.append({**row, "paper_unseen": _rounded(number)})
    return missing


def _of_experiments(comparisons: list[Comparison], primitive: str) -> list[tuple[str, str, str]]:
    """Task, transfer and model of the conditions that the runs' own experiments name."""
    named = sorted(
        {
            (condition, comparison.protocol["model"])
            for comparison in comparisons
            for group in comparison.groups
            for condition in _conditions(group.runs[0].config)
        }
    )
    split = [(*condition.split("/"), model) for condition, model in named]
    return [(task, transfer, model) for of, task, transfer, model in split if _same(of, primitive)]


def _conditions(config: dict[str, str]) -> list[str]:
    """Of a run's experiment; earlier versions called them cells."""
    conditions: list[str] = yaml.safe_load(config.get("conditions", config.get("cells", "[]")))
    return conditions


def _same(primitive: str, published: str) -> bool:
    """Whether ours is the paper's primitive: ``grasp_rg2`` is grasping too."""
    return primitive.split("_")[0] == published


def write_csv(lines: list[Row], path: Path, columns: Sequence[str] = COLUMNS) -> None:
    """All columns of all rows."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)
