"""Pictures of what a run saw and did: labels, heatmaps, picks and failures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.special import expit

from see2act.attempt import Affordances, Attempt, attempt
from see2act.datamodules.collect import Collection
from see2act.datamodules.labels import LabelSource, Task
from see2act.experiment.charts import save
from see2act.experiment.evaluation import scene_seed
from see2act.experiment.results import SPLITS
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Cause, Heightmap, Pick, Split

if TYPE_CHECKING:
    from see2act.modules.affordance import AffordanceModule
    from see2act.modules.network import PixelNetwork

TALLEST = 0.12
"""Metres at the bright end of the height pictures."""
COLUMN = 2.75
"""Inches."""
SHOWN = 4
"""Failures of a cause."""
BAND = 8
"""Attempts side by side in a strip."""


class Failures:
    """Failed attempts by cause: how many, and the first :data:`SHOWN` of each, since their images are large."""

    def __init__(self) -> None:
        self.counts: Counter[Cause] = Counter()
        self.shown: dict[Cause, list[Attempt]] = {}

    def add(self, failed: Attempt) -> None:
        """One more."""
        cause = failed.outcome.cause
        self.counts[cause] += 1
        if self.counts[cause] <= SHOWN:
            self.shown.setdefault(cause, []).append(failed)


def failures(failed: Failures, affordances: Affordances, robot: Robot, title: str, path: Path) -> None:
    """Failed attempts sorted by cause, a row each: the heightmap with the pick, and the heatmap of its angle.

    Colours of a heatmap go from 0 to its best score, so panels are not to be compared by colour.

    Args:
        failed: At least one.
        affordances: The model that chose them.
        robot: For its jaws and workspace.
        title: Over the figure.
        path: Where to.
    """
    rows, pairs = len(failed.shown), max(len(attempts) for attempts in failed.shown.values())
    size = (COLUMN * 2 * pairs, _row(robot.workspace.shape) * rows + 0.3)
    figure, grid = plt.subplots(rows, 2 * pairs, figsize=size, squeeze=False)
    for axes, (cause, attempts) in zip(grid, sorted(failed.shown.items()), strict=True):
        for axis in axes:
            axis.axis("off")
        for k, one in enumerate(attempts):
            heightmap, choice = one.heightmap, one.choice
            caption = f"{cause}, {failed.counts[cause]} of {failed.counts.total()} failures" if k == 0 else ""
            _picture(axes[2 * k], heightmap, one.pick, robot, caption)
            heatmap = expit(affordances(heightmap.color, heightmap.height)[choice.angle])
            axes[2 * k + 1].imshow(heatmap, cmap="inferno", vmin=0)  # up to its own best, since all may be near 0 in the end
            axes[2 * k + 1].set_title(f"predicted {choice.score:.2g}, best {heatmap.max():.2g}", fontsize=9)
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def strip(attempts: Sequence[Attempt], affordances: Affordances, robot: Robot, title: str, path: Path) -> None:
    """A column for each attempt: what the camera saw, the heatmap at the chosen angle, and the pick."""
    bands = math.ceil(len(attempts) / BAND)
    figure, grid = plt.subplots(3 * bands, BAND, figsize=(1.9 * BAND, 5.4 * bands + 0.3), squeeze=False)
    for axis in grid.flat:
        axis.set_axis_off()
    for i, one in enumerate(attempts):
        band, column = divmod(i, BAND)
        axes = grid[3 * band : 3 * band + 3, column]
        heightmap, choice = one.heightmap, one.choice
        axes[0].imshow(one.observation.color)
        axes[0].set_title(f"{i + 1}: {one.outcome.cause}", fontsize=9)
        axes[1].imshow(expit(affordances(heightmap.color, heightmap.height)[choice.angle]), cmap="inferno", vmin=0, vmax=1)
        axes[1].set_title(f"predicted {choice.score:.2f}", fontsize=9)
        _picture(axes[2], heightmap, one.pick, robot, "")
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def labels(collection: Collection, task: Task, source: LabelSource, name: str, count: int, path: Path) -> None:
    """Observations beside their label maps, from the simulator's truth and from vision."""
    figure, grid = plt.subplots(count, 4, figsize=(11, count * _row(collection.arrays["height"].shape[1:])), squeeze=False)
    for axes, i in zip(grid, np.linspace(0, len(collection) - 1, count).astype(int), strict=True):
        view = collection.view(int(i))
        axes[0].imshow(view.sensed.color)
        axes[1].imshow(view.sensed.height, cmap="gray", vmin=0, vmax=TALLEST)
        _overlay(axes[2], view.sensed, task.label(view, "truth"))
        _overlay(axes[3], view.sensed, task.label(view, "vision"))
    captions = {s: f"{name} from {s}" + (" (used)" if s == source else "") for s in ("truth", "vision")}
    for axis, caption in zip(grid[0], ("colour", "height", *captions.values()), strict=True):
        axis.set_title(caption, fontsize=9)
    save(figure, path)


def vision(
    held_out: Collection, task: Task, source: LabelSource, network: PixelNetwork, count: int, title: str, path: Path
) -> None:
    """Held-out observations, their labels, and what the vision model makes of them."""
    figure, grid = plt.subplots(count, 4, figsize=(11, count * _row(held_out.arrays["height"].shape[1:])), squeeze=False)
    chosen = np.linspace(0, len(held_out) - 1, count).astype(int)
    scores = network.scores(held_out.arrays["color"][chosen], held_out.arrays["height"][chosen])
    for axes, i, score in zip(grid, chosen, scores, strict=True):
        view = held_out.view(int(i))
        axes[0].imshow(view.sensed.color)
        axes[1].imshow(view.sensed.height, cmap="gray", vmin=0, vmax=TALLEST)
        _overlay(axes[2], view.sensed, task.label(view, source))
        axes[3].imshow(score, cmap="inferno", vmin=0, vmax=1)
    for axis, caption in zip(grid[0], ("colour", "height", f"label from {source}", "predicted"), strict=True):
        axis.set_title(caption, fontsize=9)
    figure.suptitle(title, fontsize=10)
    save(figure, path)


def first_attempts(
    robot: Robot, affordances: Affordances, policy: Policy, scenes: int, kind: str = "evaluate"
) -> list[tuple[Split, Attempt]]:
    """One attempt in each of some test scenes.

    Args:
        robot: Reset to each scene.
        affordances: Of the model that chooses the picks.
        policy: Turns affordances into a pick.
        scenes: Of each split.
        kind: Whose scenes they are, those of ``evaluate`` or of ``develop``.
    """
    made: list[tuple[Split, Attempt]] = []
    for split in SPLITS:
        for run in range(scenes):
            robot.reset(scene_seed(split, run, kind), split)
            made.append((split, attempt(robot, affordances, policy.fresh())))
    return made


def heatmaps(
    made: Sequence[tuple[Split, Attempt]], models: dict[str, AffordanceModule], robot: Robot, title: str, folder: Path
) -> None:
    """Test scenes through several models, and a pick in each.

    Writes ``heatmaps.png`` and ``picks.png``.

    Args:
        made: At least one attempt, with the split of its scene.
        models: By the caption to show. Heatmaps are maxima over angles.
        robot: For its jaws and workspace.
        title: Over the figures.
        folder: Where to.
    """
    columns, rows = 1 + len(models), len(made)
    size = (COLUMN * columns, _row(robot.workspace.shape) * rows + 0.3)
    maps, grid = plt.subplots(rows, columns, figsize=size, squeeze=False)
    picks, views = plt.subplots(2, 2, figsize=(11, 7))
    drawn = set()
    for row, (split, result) in enumerate(made):
        heightmap = result.heightmap
        caption = f"{split} objects, pick: {result.outcome.cause}"
        _picture(grid[row][0], heightmap, result.pick, robot, caption)
        for axis, (name, model) in zip(grid[row][1:], models.items(), strict=True):
            axis.imshow(model.affordances(heightmap.color, heightmap.height).max(0), cmap="inferno")
            axis.set_title(name, fontsize=9)
        if split not in drawn:
            drawn.add(split)
            side = views[SPLITS.index(split)]
            side[0].imshow(result.observation.color)
            side[0].set_title("from the camera", fontsize=9)
            _picture(side[1], heightmap, result.pick, robot, caption)
    maps.suptitle(title, fontsize=10)
    picks.suptitle(title, fontsize=10)
    save(maps, folder / "heatmaps.png")
    save(picks, folder / "picks.png")


def _row(shape: tuple[int, ...]) -> float:
    """Inches that a heightmap of this shape takes with its caption, ``COLUMN`` wide."""
    return COLUMN * shape[0] / shape[1] + 0.25


def _picture(axis: Axes, heightmap: Heightmap, pick: Pick, robot: Robot, caption: str) -> None:
    """A heightmap with the pick on it; for a grasp, a line between the open jaws."""
    axis.imshow(heightmap.color)
    axis.set_title(caption, fontsize=9)
    axis.plot(pick.col, pick.row, "o", color="white", markeredgecolor="black", markersize=6)
    if robot.half_opening:
        reach = robot.half_opening / robot.workspace.pixel
        du, dv = reach * math.cos(pick.angle), -reach * math.sin(pick.angle)
        axis.plot([pick.col - du, pick.col + du], [pick.row - dv, pick.row + dv], "-", color="white", linewidth=2.5)
    axis.set_xlim(-0.5, heightmap.height.shape[1] - 0.5)
    axis.set_ylim(heightmap.height.shape[0] - 0.5, -0.5)


def _overlay(axis: Axes, heightmap: Heightmap, label: np.ndarray) -> None:
    picture = heightmap.color.astype(float) / 255 * 0.6
    picture[label] = (1.0, 0.85, 0.1)
    axis.imshow(picture)
