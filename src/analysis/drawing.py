"""How groups look in all figures of a report: colours, lines, bands over seeds, legends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from see2act.analysis.groups import ENOUGH, Comparison, Group
from see2act.analysis.intervals import mean_interval

COLORS = {
    **{"none": "#4d4d4d", "normal": "#0072b2", "center": "#e69f00", "corner": "#009e73", "edge": "#d55e00"},
    **{"foreground": "#cc79a7", "imagenet": "#56b4e9", "coco": "#7b5c3e"},
}
"""Okabe and Ito's palette, which colour-blind readers can tell apart; grey for the baseline."""
OTHER_COLOR = "#8a8a2e"
LINES = {"none": "-", "full": "-", "backbone": "--", "fixed": ":"}
MARKERS = {"none": "o", "full": "o", "backbone": "s", "fixed": "D"}
STYLE: dict[Any, Any] = {
    **{"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True},
    **{"grid.alpha": 0.25, "axes.axisbelow": True, "legend.frameon": False, "legend.fontsize": 8, "figure.facecolor": "white"},
    **{"svg.hashsalt": "see2act"},  # the same runs give the same file
}


def band(axes: Axes, x: np.ndarray, each: np.ndarray, color: Any, style: dict[str, Any], label: str | None) -> None:
    """Mean over seeds (rows of ``each``) with its band, or with the seeds where they are too few for one."""
    axes.plot(x, each.mean(axis=0), label=label, **style)
    if len(each) >= ENOUGH:
        low, high = np.array([mean_interval(column) for column in each.T.tolist()]).T
        axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    elif len(each) > 1:
        axes.plot(x, each.T, color=color, alpha=0.35, linewidth=0.8, linestyle=style["linestyle"])


def level(axes: Axes, each: list[float], style: dict[str, Any], label: str | None = None) -> None:
    """What is never fine-tuned stays as it is."""
    axes.axhline(float(np.mean(each)), label=label, **style | {"marker": ""})


def dots(each: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Means, and distances (2, n) to the limits of their intervals: 0 where seeds are too few for one."""
    means = np.array([np.mean(values) for values in each])
    limits = [(mean_interval(v) if len(v) >= ENOUGH else None) or (m, m) for v, m in zip(each, means, strict=True)]
    return means, np.abs(np.array(limits).T - means)


def look(comparison: Comparison, group: Group) -> tuple[Any, dict[str, Any]]:
    """Colour by source, line by transfer, and lighter with other markers for further configurations of the same."""
    twins = [other for other in comparison.groups if (other.task, other.transfer) == (group.task, group.transfer)]
    place = twins.index(group)
    rgb = np.array(to_rgb(COLORS.get(group.task, OTHER_COLOR)))
    color = tuple(rgb + (1 - rgb) * 0.55 * place / max(1, len(twins) - 1))
    marker = MARKERS.get(group.transfer, "^") if place == 0 else "vPX*<>"[(place - 1) % 6]
    style = {"color": color, "linestyle": LINES.get(group.transfer, "-."), "marker": marker, "markersize": 4, "linewidth": 1.6}
    return color, style


def legend(figure: Figure, axes: Axes) -> None:
    """Below the figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))


def band_words(groups: Sequence[Group]) -> str:
    """What a caption says of bands."""
    words = "Band: 95 % t interval over seeds"
    return f"{words}; below {ENOUGH} seeds thin lines instead, one a seed." if few(groups) else f"{words}."


def bar_words(groups: Sequence[Group]) -> str:
    """What a caption says of error bars."""
    words = "Bars: 95 % t interval over seeds"
    return f"{words}; none below {ENOUGH} seeds." if few(groups) else f"{words}."


def few(groups: Sequence[Group]) -> bool:
    """Whether a group has too few seeds for an interval."""
    return any(len(group.runs) < ENOUGH for group in groups)
