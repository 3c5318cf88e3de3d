"""The numbers of a report: a row for every group, and what may be concluded from two of them."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from see2act.analysis import paper
from see2act.analysis.commands import command_for
from see2act.analysis.groups import ENOUGH, Comparison, Found, Group
from see2act.analysis.intervals import (
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    mean_difference_interval,
    mean_interval,
    t_interval,
)
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
IQM = ("after_unseen_iqm", "after_unseen_iqm_low", "after_unseen_iqm_high")
COLUMNS = (
    *("primitive", "protocol", "task", "transfer", "model", "config_hash", "differs", "seeds", "paper_unseen"),
    *(f"{measure}_{part}" for measure in (*MEASURES, LEARNING) for part in PARTS),
    *(f"{gain}_{part}" for gain in GAINS for part in GAIN_PARTS),
    *(*IQM, "note"),
)
PROGRESS_COLUMNS = ("primitive", "protocol", "task", "transfer", "model", "config_hash", "seeds", "step", "split", *PARTS)
Row = dict[str, str]
"""Column to text, exactly as it is shown; empty where there is no number."""


def rates(group: Group, measure: str) -> list[float]:
    """Success rate of each seed, or of one where all seeds are one measurement; empty where a group has none."""
    return _rates(group.runs[:1] if one_measurement(group, measure) else group.runs, measure)


def one_measurement(group: Group, measure: str) -> bool:
    """Whether a group's seeds repeat each other: before it learns, nothing of a model whose head was copied is a seed's."""
    untouched = measure.startswith("zero_shot") or (not group.learned and measure != LEARNING)
    if len(group.runs) < 2 or not untouched or group.transfer not in ("full", "fixed"):
        return False
    return len({tuple(run.scores(*MEASURES[measure])) for run in group.runs}) == 1


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
    lines = []
    for group in comparison.groups:
        steps = [{point.step: point for point in run.result.evals} for run in group.runs]
        for split in SPLITS:
            for step in sorted(set.intersection(*map(set, steps))):
                counts = [(at[step][split].successes, at[step][split].attempts) for at in steps]
                if step == 0 and one_measurement(group, f"zero_shot_{split}"):
                    counts = counts[:1]
                lines.append({**_identity(comparison, group), "step": str(step), "split": split, **_summed(counts)})
    return lines


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
        row |= {f"{gain}_{part}": text for gain, pair in GAINS.items() for part, text in _gained(group, *pair).items()}
    scores = scores_of(group)
    interval = interquartile_interval([scores]) if len(scores) >= ENOUGH else (None, None)
    row |= dict(zip(IQM, map(_text, (float(interquartile_mean(scores.ravel())), *interval)), strict=True))
    return row | {"note": "" if group.learned else "never fine-tuned"}


def _measured(group: Group, measure: str) -> Row:
    runs = group.runs[:1] if one_measurement(group, measure) else group.runs
    return _summed([_counts(run, measure) for run in runs]) if _rates(runs, measure) else {}


def _summed(counts: list[tuple[int, int]]) -> Row:
    """Successes and attempts of each seed as ``PARTS``."""
    each = [successes / attempts for successes, attempts in counts]
    successes, attempts = (sum(column) for column in zip(*counts, strict=True))
    interval = mean_interval(each) if len(each) >= ENOUGH else None
    numbers = (float(np.mean(each)), *(interval or (None, None)), successes, attempts, *wilson(successes, attempts))
    return dict(zip(PARTS, map(_text, numbers), strict=True))


def _gained(group: Group, after: str, before: str) -> Row:
    each = [a - b for a, b in zip(_rates(group.runs, after), _rates(group.runs, before), strict=True)]
    interval = t_interval(each) if len(each) >= ENOUGH else None
    numbers = (float(np.mean(each)), *(interval or (None, None)), min(each))
    return dict(zip(GAIN_PARTS, map(_text, numbers), strict=True))


def _rates(runs: Sequence[Run], measure: str) -> list[float]:
    return [successes / attempts for successes, attempts in (_counts(run, measure) for run in runs) if attempts]


def _counts(run: Run, measure: str) -> tuple[int, int]:
    return run.learning if measure == LEARNING else run.counts(*MEASURES[measure])


def _text(number: float | int | None) -> str:
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


def scores_of(group: Group, measure: str = "after_unseen") -> np.ndarray:
    """Success rate (seed, test run); of one seed where all are one measurement."""
    runs = group.runs[:1] if one_measurement(group, measure) else group.runs
    return np.array([run.scores(*MEASURES[measure]) for run in runs])


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
    compared = []
    for group, other in pairs:
        a, b = (rates(each, measure) for each in (group, other))
        if not (a and b):
            continue
        left, right = np.array(a), np.array(b)
        low, high = improvement_interval(left, right)
        limits = mean_difference_interval(a, b)
        numbers: tuple[float | None, ...] = (None,) * 6
        if limits and min(len(a), len(b)) >= ENOUGH:
            numbers = (float(improvement(left, right)), low, high, float(left.mean() - right.mean()), *limits)
        told = verdict(len(a), len(b), (low, high), limits or (-math.inf, math.inf))
        compared.append(Contrast(group, other, measure, told, *map(_text, numbers)))
    return compared


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
        odds = "always" if chance >= 1 else f"one time in {1 / chance:.2g}"
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
        together.append(Aggregate(kind, ", ".join(group.task for group in groups), *map(_text, (mean, *interval))))
    return together


def write_csv(lines: list[Row], path: Path, columns: Sequence[str] = COLUMNS) -> None:
    """All columns of all rows."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)


def write_markdown(lines: list[Row], path: Path) -> None:
    """The columns that a reader looks for first."""
    text = ["| primitive | source | transfer | configuration | seeds | paper, unseen | " + " | ".join(SHORT) + " | note |"]
    text.append("|" + "---|" * (text[0].count("|") - 1))
    for row in lines:
        protocol = f"protocol {row['protocol']}," if row["protocol"] else ""
        hashed = f"`{row['config_hash']}`" if row["config_hash"] else ""
        configuration = " ".join(filter(None, (row["model"], protocol, hashed, row["differs"])))
        cells = [row["primitive"], row["task"], row["transfer"], configuration, row["seeds"], row["paper_unseen"]]
        cells += [_cell(row, measure) for measure in SHORT.values()] + [row["note"]]
        text.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    text += ["", "Mean over seeds [95 % t interval] (successes/attempts)."]
    with replacing(path) as partial:
        partial.write_text("\n".join(text) + "\n")


SHORT = {
    "after, unseen": "after_unseen",
    "after, seen": "after_seen",
    "zero-shot, unseen": "zero_shot_unseen",
    "zero-shot, seen": "zero_shot_seen",
}


def _cell(row: Row, measure: str) -> str:
    mean, low, high, successes, attempts, *_ = (row[f"{measure}_{part}"] for part in PARTS)
    if not mean:
        return ""
    return f"{mean} {f'[{low}, {high}] ' if low else ''}({successes}/{attempts})"
