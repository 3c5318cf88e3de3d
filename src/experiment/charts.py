"""Charts of a run: its learning curve, and how its picks came about."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from see2act.experiment.attempts import TESTED, AttemptRow
from see2act.experiment.results import BLOCK, SPLITS, curve, wilson
from see2act.files import replacing

if TYPE_CHECKING:
    pass

ABOVE_FLOOR = 0.01
"""Metres: a pick above is on an object, or a wall."""


def learning_curve(rows: Sequence[AttemptRow], path: Path, title: str) -> None:
    """Success while learning in blocks of attempts with Wilson intervals, and the evaluations on the way."""
    figure, axes = plt.subplots(figsize=(6, 4))
    if points := curve(rows):
        x = [point.step for point in points]
        y = np.array([point.success_rate for point in points])
        low, high = np.array([wilson(point.successes, point.attempts) for point in points]).T
        axes.fill_between(x, low, high, alpha=0.2, color="C0", linewidth=0)
        axes.plot(x, y, "o-", color="C0", label=f"while learning, blocks of {BLOCK}")
    tested = [row for row in rows if row.phase in TESTED]
    rule = tested[0].policy
    for color, split in zip(("C2", "C3"), SPLITS, strict=True):
        by_step: dict[int, list[int]] = {}
        for row in tested:
            if row.split == split and row.policy == rule:
                by_step.setdefault(row.step, []).append(row.success)
        steps = sorted(by_step)
        rates = [float(np.mean(by_step[s])) for s in steps]
        low, high = np.array([wilson(sum(by_step[s]), len(by_step[s])) for s in steps]).reshape(-1, 2).T
        error = (rates - low, high - rates)
        axes.errorbar(steps, rates, error, fmt="s--", color=color, capsize=3, label=f"evaluated, {split} objects")
    axes.set(xlabel="attempts", ylabel="success rate", ylim=(-0.02, 1.02), title=title)
    axes.legend(loc="best", fontsize=8)
    axes.grid(alpha=0.3)
    save(figure, path)


def diagnosis(rows: Sequence[AttemptRow], path: Path, title: str) -> None:
    """How learning went: causes of failure, where and how confidently was picked, and how well predictions are calibrated."""
    learning = [row for row in rows if row.phase == "finetune"]
    blocks = [learning[i : i + BLOCK] for i in range(0, len(learning), BLOCK)]
    steps = [block[-1].step for block in blocks]
    figure, (causes, where, calibration) = plt.subplots(1, 3, figsize=(15, 4.2))
    below = np.zeros(len(blocks))
    for cause in sorted({row.cause for row in learning}, key=lambda cause: (cause != "ok", cause)):
        share = np.array([np.mean([row.cause == cause for row in block]) for block in blocks])
        causes.bar(steps, share, width=0.8 * BLOCK, bottom=below, label=cause)
        below += share
    causes.set(xlabel="attempts", ylabel="share", title="what came of attempts while learning")
    curves = {
        "on something (> 1 cm)": lambda block: np.mean([row.z > ABOVE_FLOOR for row in block]),
        "near an earlier pick of the bin": lambda block: np.mean([_near_earlier(row, learning) for row in block]),
        "predicted success": lambda block: np.mean([row.score for row in block]),
        "successful": lambda block: np.mean([row.success for row in block]),
        "entropy of the draw / 15 nats": lambda block: np.mean([row.entropy for row in block]) / 15,
    }
    for name, measure in curves.items():
        where.plot(steps, [measure(block) for block in blocks], "o-", markersize=3, label=name)
    where.set(xlabel="attempts", ylim=(-0.02, 1.02), title=f"blocks of {BLOCK} attempts")
    calibration.plot([0, 1], [0, 1], ":", color="gray")
    last = max(row.step for row in rows)
    tested = [row for row in rows if row.policy == rows[0].policy]  # the plain argmax is tested beside it
    phases = {
        "zero-shot": [row for row in tested if row.phase == "zero_shot"],
        "while learning": learning,
        f"after {last}": [row for row in tested if row.phase == "eval" and row.step == last],
    }
    for name, group in phases.items():
        points = _reliability(group)
        if points:
            predicted, observed, low, high = np.array(points).T
            calibration.errorbar(predicted, observed, (observed - low, high - observed), fmt="o-", capsize=2, label=name)
    calibration.set(xlabel="predicted", ylabel="observed", xlim=(0, 1), ylim=(0, 1), title="success of the executed picks")
    for axis in (causes, where, calibration):
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7)
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def _near_earlier(row: AttemptRow, rows: Sequence[AttemptRow]) -> bool:
    """Whether the pick lies within a centimetre of an earlier one of the same episode."""
    earlier = [r for r in rows if r.episode == row.episode and r.step < row.step]
    return any(math.hypot(r.x - row.x, r.y - row.y) <= 0.01 for r in earlier)


def _reliability(rows: Sequence[AttemptRow]) -> list[tuple[float, float, float, float]]:
    """Mean prediction, observed rate and its Wilson interval in tenths of the predicted probability."""
    points = []
    for tenth in range(10):
        group = [row for row in rows if min(9, int(row.score * 10)) == tenth]
        if group:
            successes = sum(row.success for row in group)
            predicted = float(np.mean([row.score for row in group]))
            points.append((predicted, successes / len(group), *wilson(successes, len(group))))
    return points


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure as PNG at once, without ticks on its pictures, and forget it."""
    for axis in figure.axes:
        if axis.images:
            axis.set_xticks([])
            axis.set_yticks([])
    figure.tight_layout()
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    plt.close(figure)
