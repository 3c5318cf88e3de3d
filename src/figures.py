"""Pictures of a run, for people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from see2act import attempts_csv
from see2act.attempt import attempt
from see2act.datamodules.collect import Collection
from see2act.datamodules.labels import Means, Task
from see2act.evaluation import SPLITS, scene_seed
from see2act.files import replacing
from see2act.policy import Policy
from see2act.results import BLOCK, curve
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Pick
from see2act.statistics import wilson

if TYPE_CHECKING:
    from see2act.modules.affordance import AffordanceModule
    from see2act.modules.network import PixelNetwork

TALLEST = 0.12
"""Metres at the bright end of the height pictures."""
JAWS = 0.043
"""Metres from the middle of the open gripper to a pad."""


def learning_curve(attempts: Path, path: Path, title: str) -> None:
    """Success while learning in blocks of attempts with Wilson intervals, and the evaluations on the way."""
    figure, axes = plt.subplots(figsize=(6, 4))
    points = curve(attempts)
    if points:
        x = [p["step"] for p in points]
        y = np.array([p["successes"] / p["attempts"] for p in points])
        low, high = np.array([wilson(p["successes"], p["attempts"]) for p in points]).T
        axes.fill_between(x, low, high, alpha=0.2, color="C0", linewidth=0)
        axes.plot(x, y, "o-", color="C0", label=f"while learning, blocks of {BLOCK}")
    rows = [row for row in attempts_csv.read(attempts) if row["phase"] != "finetune"]
    rule = rows[0]["policy"]
    for color, split in zip(("C2", "C3"), SPLITS, strict=True):
        by_step: dict[int, list[int]] = {}
        for row in rows:
            if row["split"] == split and row["policy"] == rule:
                by_step.setdefault(int(row["step"]), []).append(int(row["success"]))
        steps = sorted(by_step)
        rates = [float(np.mean(by_step[s])) for s in steps]
        bounds = np.array([wilson(sum(by_step[s]), len(by_step[s])) for s in steps])
        error = np.abs(bounds.T - rates)
        axes.errorbar(steps, rates, error, fmt="s--", color=color, capsize=3, label=f"evaluated, {split} objects")
    axes.set(xlabel="attempts", ylabel="success rate", ylim=(-0.02, 1.02), title=title)
    axes.legend(loc="best", fontsize=8)
    axes.grid(alpha=0.3)
    _save(figure, path)


def labels(collection: Collection, task: Task, means: Means, name: str, count: int, path: Path) -> None:
    """Observations beside their label maps, by both means where they differ."""
    figure, grid = plt.subplots(count, 4, figsize=(11, 2.9 * count), squeeze=False)
    for axes, i in zip(grid, np.linspace(0, len(collection) - 1, count).astype(int), strict=True):
        view = collection.view(int(i))
        axes[0].imshow(view.sensed.color)
        axes[1].imshow(view.sensed.height, cmap="gray", vmin=0, vmax=TALLEST)
        _overlay(axes[2], view.sensed, task.label(view, "truth"))
        _overlay(axes[3], view.sensed, task.label(view, "vision"))
    captions = {m: f"{name} by {m}" + (" (used)" if m == means else "") for m in ("truth", "vision")}
    for axis, caption in zip(grid[0], ("colour", "height", *captions.values()), strict=True):
        axis.set_title(caption, fontsize=9)
    _save(figure, path)


def vision(held_out: Collection, task: Task, means: Means, network: PixelNetwork, count: int, title: str, path: Path) -> None:
    """Held-out observations, their labels, and what the vision model makes of them."""
    figure, grid = plt.subplots(count, 4, figsize=(11, 2.9 * count), squeeze=False)
    chosen = np.linspace(0, len(held_out) - 1, count).astype(int)
    scores = network.scores(held_out.arrays["color"][chosen], held_out.arrays["height"][chosen])
    for axes, i, score in zip(grid, chosen, scores, strict=True):
        view = held_out.view(int(i))
        axes[0].imshow(view.sensed.color)
        axes[1].imshow(view.sensed.height, cmap="gray", vmin=0, vmax=TALLEST)
        _overlay(axes[2], view.sensed, task.label(view, means))
        axes[3].imshow(score, cmap="inferno", vmin=0, vmax=1)
    for axis, caption in zip(grid[0], ("colour", "height", f"label by {means}", "predicted"), strict=True):
        axis.set_title(caption, fontsize=9)
    figure.suptitle(title, fontsize=10)
    _save(figure, path)


def heatmaps(robot: Robot, models: dict[str, AffordanceModule], policy: Policy, scenes: int, title: str, folder: Path) -> None:
    """Evaluation scenes through several models, and the last model's pick carried out.

    Writes ``heatmaps.png`` and ``picks.png``.

    Args:
        robot: Reset to each scene.
        models: By the caption to show; the last one chooses the picks. Heatmaps are maxima over angles.
        policy: Turns affordances into a pick.
        scenes: Of each split.
        title: Over the figures.
        folder: Where to.
    """
    maps, grid = plt.subplots(scenes * 2, 1 + len(models), figsize=(2.9 * (1 + len(models)), 3.3 * scenes * 2), squeeze=False)
    picks, views = plt.subplots(2, 2, figsize=(11, 7))
    chooser = list(models.values())[-1]
    for row, (split, run) in enumerate((s, r) for s in SPLITS for r in range(scenes)):
        robot.reset(scene_seed(split, run), split)
        result = attempt(robot, chooser.affordances, policy.fresh())
        heightmap = result.heightmap
        caption = f"{split} objects, pick: {result.outcome.cause}"
        _picture(grid[row][0], heightmap, result.pick, robot, caption)
        for axis, (name, model) in zip(grid[row][1:], models.items(), strict=True):
            axis.imshow(model.affordances(heightmap.color, heightmap.height).max(0), cmap="inferno")
            axis.set_title(name, fontsize=9)
        if run == 0:
            side = views[SPLITS.index(split)]
            side[0].imshow(result.observation.color)
            side[0].set_title("from the camera", fontsize=9)
            _picture(side[1], heightmap, result.pick, robot, caption)
    maps.suptitle(title, fontsize=10)
    picks.suptitle(title, fontsize=10)
    _save(maps, folder / "heatmaps.png")
    _save(picks, folder / "picks.png")


def _picture(axis: Axes, heightmap: Heightmap, pick: Pick, robot: Robot, caption: str) -> None:
    """A heightmap with the pick on it; for a grasp, a line between the open jaws."""
    axis.imshow(heightmap.color)
    axis.set_title(caption, fontsize=9)
    axis.plot(pick.col, pick.row, "o", color="white", markeredgecolor="black", markersize=6)
    if robot.primitive == "grasp":
        reach = JAWS / robot.workspace.pixel
        du, dv = reach * math.cos(pick.angle), -reach * math.sin(pick.angle)
        axis.plot([pick.col - du, pick.col + du], [pick.row - dv, pick.row + dv], "-", color="white", linewidth=2.5)
    axis.set_xlim(-0.5, heightmap.height.shape[1] - 0.5)
    axis.set_ylim(heightmap.height.shape[0] - 0.5, -0.5)


def _overlay(axis: Axes, heightmap: Heightmap, label: np.ndarray) -> None:
    picture = heightmap.color.astype(float) / 255 * 0.6
    picture[label] = (1.0, 0.85, 0.1)
    axis.imshow(picture)


def _save(figure: plt.Figure, path: Path) -> None:
    for axis in figure.axes:
        if axis.images:
            axis.set_xticks([])
            axis.set_yticks([])
    figure.tight_layout()
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    plt.close(figure)
