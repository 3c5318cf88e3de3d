"""The figures of a report, one comparison at a time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from see2act.analysis.drawing import OTHER_COLOR, STYLE, band, band_words, bar_words, dots, legend, level, look
from see2act.analysis.groups import Comparison, Group
from see2act.analysis.reaching import TARGET, reaching, tested_at
from see2act.analysis.summary import published_for, rates
from see2act.experiment.attempts import TESTED
from see2act.experiment.results import BLOCK, SPLITS
from see2act.files import replacing

CAUSES = {
    **{"missed": "#b3b3b3", "no_seal": "#56b4e9", "slipped": "#e69f00", "collision": "#d55e00"},
    **{"wall": "#7b5c3e", "unreachable": "#4d4d4d", "ok": "#009e73"},
}
"""Colours; what is called ``ok`` here was held, and not sensed."""


@dataclass(frozen=True)
class Picture:
    """A figure that was written."""

    path: Path
    """Of the PNG; the SVG is beside it."""
    width: float
    """Inches."""
    title: str
    caption: str
    alt: str


def clear(folder: Path, drawn: Iterable[Picture]) -> None:
    """Remove figures of an earlier report that this one has not drawn again: they may be of other runs."""
    kept = {picture.path.stem for picture in drawn}
    name = re.compile(rf"({'|'.join(kind for kind, *_ in FIGURES)})-[a-z0-9_]+(-\d+)?")
    for path in [*folder.glob("*.png"), *folder.glob("*.svg")]:
        if name.fullmatch(path.stem) and path.stem not in kept:
            path.unlink()


def draw(comparison: Comparison, folder: Path) -> Iterator[Picture]:
    """Write all figures of a comparison, one by one."""
    for kind, title, plot in FIGURES:
        with plt.rc_context(STYLE):
            drawn = plot(comparison)
            if drawn is None:
                continue
            figure, caption, alt = drawn
            path = folder / f"{kind}-{comparison.slug}.png"
            for suffix, options in ((".png", {"dpi": 150}), (".svg", {"metadata": {"Date": None}})):
                with replacing(path.with_suffix(suffix)) as partial:
                    figure.savefig(partial, format=suffix[1:], **options)
            plt.close(figure)
        yield Picture(path, figure.get_figwidth(), f"{title}: {comparison.name}", caption, alt)


Drawn = tuple[Figure, str, str] | None
"""A figure, its caption, and a text that stands for it; None where there is nothing to draw."""


def curves(comparison: Comparison) -> Drawn:
    """Success while learning, over attempts and over the robot's minutes."""
    groups = _overview(comparison)
    learned = [group for group in groups if rates(group, "learning")]
    if not learned:
        return None
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.9), sharey=True, layout="constrained")
    for group in groups:
        color, style = look(comparison, group)
        if group not in learned:
            for axes in (left, right):
                level(axes, rates(group, "zero_shot_seen"), style)
            left.plot([], [], label=f"{group.name} (by the protocol)", **style | {"marker": ""})
            continue
        blocks = _blocks(group)
        band(left, blocks.steps, blocks.rates, color, style, group.name)
        if blocks.timed.any():
            band(right, blocks.minutes.mean(axis=0), blocks.rates[blocks.timed], color, style, None)
    left.set(xlabel="fine-tuning attempts", ylabel="success rate while learning", ylim=(-0.02, 1.02))
    right.set(xlabel="minutes of robot motion")
    left.set_xlim(left=0)
    right.set_xlim(left=0)
    legend(figure, left)
    ends = "; ".join(f"{group.name} {_last(group):.2f}" for group in learned)
    caption = (
        f"Blocks of {BLOCK} exploring attempts, mean over seeds. {band_words(learned)} "
        "Minutes are of robot motion alone, without computing; a block stands at its mean over seeds."
    )
    return figure, caption, f"Success rate against attempts and against robot minutes. In the last block: {ends}."


def protocol(comparison: Comparison) -> Drawn:
    """Success by the protocol, on the way."""
    groups = _overview(comparison)
    figure, grid = plt.subplots(1, 2, figsize=(10, 3.9), sharey=True, layout="constrained")
    most = tested_at(groups)[-1]
    if most == 0:
        plt.close(figure)
        return None
    ticks = _spaced(tested_at(groups), most / 16)
    for axes, split in zip(grid, reversed(SPLITS), strict=True):
        for i, group in enumerate(groups):
            _, style = look(comparison, group)
            evals = [{point.step: point[split].success_rate for point in run.result.evals} for run in group.runs]
            steps = sorted(set.intersection(*map(set, evals)))
            each = [[rates_at[step] for rates_at in evals] for step in steps]
            if steps == [0]:
                level(axes, each[0], style, group.name)
                continue
            shift = (i - (len(groups) - 1) / 2) * most * 0.008  # so that error bars do not hide each other
            axes.errorbar(np.array(steps) + shift, *dots(each), label=group.name, capsize=2.5, elinewidth=0.9, **style)
        axes.set(xlabel="fine-tuning attempts", title=f"{split} objects", ylim=(-0.02, 1.02), xticks=ticks)
    grid[0].set_ylabel("success rate by the protocol")
    legend(figure, grid[0])
    ends = "; ".join(f"{group.name} {np.mean(rates(group, 'after_unseen')):.2f}" for group in groups)
    caption = f"Evaluated with frozen weights, mean over seeds. {bar_words(groups)} Points are shifted a little sideways."
    return figure, caption, f"Success rate by the protocol against attempts. On unseen objects at the end: {ends}."


def reach(comparison: Comparison) -> Drawn:
    """How many attempts each source needs."""
    known = [(group, found) for group in comparison.groups if (found := reaching(group))]
    if not known:
        return None
    last = max(found.last for _, found in known)
    beyond = 1.1 * last  # where runs stand that did not reach the target
    figure, axes = plt.subplots(figsize=(7.5, 1.1 + 0.42 * len(known)), layout="constrained")
    places = np.arange(len(known))[::-1]
    for place, (group, found) in zip(places, known, strict=True):
        color, style = look(comparison, group)
        median, each = (np.minimum(values, beyond) for values in (found.median, found.each))
        above = [0.18 + 0.045 * list(each[:i]).count(value) for i, value in enumerate(each)]  # equal seeds, one on another
        axes.plot(each, place + np.array(above), ".", color=color, alpha=0.8, markersize=3)
        limits = np.minimum(found.interval or (median, median), beyond)
        axes.errorbar([median], [place], xerr=np.abs(limits[:, None] - median), capsize=3, **style | {"linestyle": "none"})
    axes.axvspan(1.05 * last, 1.15 * last, color="#000000", alpha=0.06, linewidth=0)
    ticks = [step for step in _spaced(tested_at([group for group, _ in known]), last / 16) if step <= last]
    axes.set_xticks([*ticks, beyond], [*map(str, ticks), "not\nreached"])
    axes.set(xlim=(-0.02 * last, 1.15 * last), ylim=(-0.5, len(known) - 0.2))
    axes.set_xlabel(f"fine-tuning attempts until success on unseen objects is {TARGET}")
    axes.set_yticks(places, [group.name for group, _ in known])
    axes.grid(axis="y", visible=False)
    told = "; ".join(f"{group.name} {found.text(found.median)}" for group, found in known)
    caption = (
        f"Attempts before the first test by the protocol with a success rate of {TARGET} or more on unseen objects. "
        f"Large points are medians over seeds, small ones above them the seeds. Bars: exact 95 % interval of the median"
        f"{', none below six seeds' if any(found.interval is None for _, found in known) else ''}."
    )
    return figure, caption, f"Median attempts until success on unseen objects is {TARGET}: {told}."


def _spaced(steps: Sequence[int], least: float) -> list[int]:
    """The steps that are at least so far from the last one that was taken."""
    taken: list[int] = []
    for step in steps:
        if not taken or step - taken[-1] >= least:
            taken.append(step)
    return taken


def transfer_curves(comparison: Comparison) -> Drawn:
    """None, backbone and full beside each other while learning, a panel for each source."""
    sources = [task for task in dict.fromkeys(group.task for group in comparison.groups) if task != "none"]
    sources = [t for t in sources if len({group.transfer for group in comparison.groups if group.task in (t, "none")}) > 1]
    if not sources:
        return None
    width = min(3, len(sources))
    height = -(-len(sources) // width)
    size = (max(5.5, 3.4 * width), 2.9 * height + 0.3)
    figure, grid = plt.subplots(height, width, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")
    for axes, task in zip(grid.flat, sources, strict=False):
        for group in (group for group in comparison.groups if group.task in (task, "none")):
            color, style = look(comparison, group)
            label = group.name if group.task == "none" else group.name.removeprefix(f"{task}, ")
            if rates(group, "learning"):
                blocks = _blocks(group)
                band(axes, blocks.steps, blocks.rates, color, style, label)
            else:
                level(axes, rates(group, "zero_shot_seen"), style, f"{label} (by the protocol)")
        axes.set(title=task, ylim=(-0.02, 1.02))
        axes.legend(loc="best", frameon=True, framealpha=0.85, edgecolor="none")
    for place, axes in enumerate(grid.flat):
        axes.set_visible(place < len(sources))
        axes.tick_params(labelbottom=place + width >= len(sources))
    figure.supxlabel("fine-tuning attempts", fontsize=9)
    figure.supylabel("success rate while learning", fontsize=9)
    caption = f"What is transferred, source by source. {band_words(comparison.groups)}"
    return figure, caption, f"Success while learning by what was transferred, a panel for each of {', '.join(sources)}."


def transfer(comparison: Comparison) -> Drawn:
    """Final success by source and transfer."""
    return _by_source(comparison, ("after_unseen", "after_seen"), "after fine-tuning")


def zero_shot(comparison: Comparison) -> Drawn:
    """Success before the first attempt by source and transfer."""
    return _by_source(comparison, ("zero_shot_unseen", "zero_shot_seen"), "before fine-tuning")


def _by_source(comparison: Comparison, measures: Sequence[str], when: str) -> Drawn:
    groups = [group for group in comparison.groups if rates(group, measures[0])]
    if not groups:
        return None
    figure, grid = plt.subplots(1, 2, figsize=(10, 0.9 + 0.36 * len(groups)), sharex=True, sharey=True, layout="constrained")
    places = np.arange(len(groups))[::-1]
    for axes, measure in zip(grid, measures, strict=True):
        for place, group in zip(places, groups, strict=True):
            color, style = look(comparison, group)
            each = rates(group, measure)
            mean, error = dots([each])
            axes.plot(each, np.full(len(each), place + 0.22), "|", color=color, alpha=0.8, markersize=6)
            axes.errorbar(mean, [place], xerr=error, capsize=3, **style | {"linestyle": "none"})
            if measure == "after_unseen" and (published := published_for(comparison, group)) is not None:
                axes.plot(
                    published, place - 0.25, "*", color="none", markeredgecolor="#1d2327", markersize=8, label="the paper"
                )
        axes.set(xlim=(-0.02, 1.02), title=f"{measure.split('_')[-1]} objects", xlabel=f"success rate {when}")
        axes.set_ylim(-0.6, len(groups) - 0.4)
        axes.set_yticks(places, [group.name for group in groups])
        axes.grid(axis="y", visible=False)
    if stars := grid[0].get_legend_handles_labels()[0]:
        figure.legend(stars[:1], ["the paper"], loc="outside lower center")
    told = "; ".join(f"{group.name} {np.mean(rates(group, measures[0])):.2f}" for group in groups)
    caption = f"Points are means over seeds, ticks above them the seeds. {bar_words(groups)}"
    return figure, caption, f"Success rate {when} by source and transfer. On unseen objects: {told}."


def causes(comparison: Comparison) -> Drawn:
    """Why attempts failed, before, while and after learning."""
    groups = [group for group in comparison.groups if any(run.attempts for run in group.runs)]
    if not groups:
        return None
    stages = ("zero-shot", "while learning", "after, by the protocol")
    figure, grid = plt.subplots(1, 3, figsize=(10, 1.3 + 0.34 * len(groups)), sharex=True, sharey=True, layout="constrained")
    places, seen, told = np.arange(len(groups))[::-1], set(), []
    for axes, stage in zip(grid, stages, strict=True):
        for place, group in zip(places, groups, strict=True):
            share = _failures(group, stage)
            left = 0.0
            for cause in sorted(share, key=lambda c: list(CAUSES).index(c) if c in CAUSES else len(CAUSES)):
                axes.barh(place, share[cause], 0.66, left=left, color=CAUSES.get(cause, OTHER_COLOR), edgecolor="white")
                left += share[cause]
                seen.add(cause)
            if share and stage == "while learning":
                told.append(f"{group.name} mostly {max(share, key=lambda c: share[c])}")
        axes.set(title=stage, xlim=(0, 1), xticks=(0, 0.25, 0.5, 0.75, 1), xticklabels=("0", "", "0.5", "", "1"))
        axes.grid(axis="y", visible=False)
    grid[0].set_yticks(places, [group.name for group in groups])
    grid[1].set_xlabel("share of attempts that failed")
    names = [cause for cause in [*CAUSES, *sorted(seen - {*CAUSES})] if cause in seen]
    patches = [plt.Rectangle((0, 0), 1, 1, color=CAUSES.get(cause, OTHER_COLOR)) for cause in names]
    labels = ["held, not sensed" if cause == "ok" else cause.replace("_", " ") for cause in names]
    figure.legend(patches, labels, loc="outside lower center", ncols=max(1, len(names)))
    caption = "Length: share of all attempts, seen and unseen, all seeds together. Colour: the cause in attempts.csv."
    return figure, caption, f"Failures by cause. While learning: {'; '.join(told) or 'no attempts'}."


FIGURES: tuple[tuple[str, str, Callable[[Comparison], Drawn]], ...] = (
    ("curves", "Learning by trial and error", curves),
    ("protocol", "Tested on the way", protocol),
    ("reach", f"Attempts until success is {TARGET}", reach),
    ("transfer-curves", "What is transferred, while learning", transfer_curves),
    ("transfer", "What is transferred, afterwards", transfer),
    ("zero-shot", "Zero-shot", zero_shot),
    ("causes", "Why attempts failed", causes),
)


@dataclass(frozen=True)
class _Blocks:
    """Fine-tuning in blocks.

    Args:
        steps: (n,), at which blocks end.
        rates: (seed, n).
        timed: Which seeds have an attempts.csv.
        minutes: (timed seed, n) of robot motion.
    """

    steps: np.ndarray
    rates: np.ndarray
    timed: np.ndarray
    minutes: np.ndarray


def _blocks(group: Group) -> _Blocks:
    length = min(len(run.result.curve) for run in group.runs)
    each = [[block.success_rate for block in run.result.curve[:length]] for run in group.runs]
    steps = np.array([block.step for block in group.runs[0].result.curve[:length]])
    timed = [bool(run.attempts) for run in group.runs]
    clocks = [
        np.cumsum([row.robot_seconds for row in run.attempts if row.phase == "finetune"])[steps - 1] / 60
        for run in group.runs
        if run.attempts
    ]
    return _Blocks(steps, np.array(each), np.array(timed), np.array(clocks))


def _overview(comparison: Comparison) -> list[Group]:
    """The paper's groups: the baseline and whole models; or all of them where that would leave a source out."""
    shown = [group for group in comparison.groups if group.transfer in ("none", "full")]
    return shown + [group for group in comparison.groups if group.task not in {a.task for a in shown}]


def _last(group: Group) -> float:
    return float(_blocks(group).rates[:, -1].mean())


def _failures(group: Group, stage: str) -> dict[str, float]:
    """Share of a group's attempts at a stage that failed, by cause."""
    last = max(point.step for point in group.runs[0].result.evals)
    step = {"zero-shot": 0, "while learning": None}.get(stage, last)
    policy = group.runs[0].choices.get("policy")
    rows = [
        row
        for run in group.runs
        for row in run.attempts
        if (row.phase == "finetune" if step is None else row.phase in TESTED and row.step == step)
        and (step is None or row.policy == policy)
    ]
    failed = Counter(row.cause for row in rows if not row.success)
    return {cause: count / len(rows) for cause, count in failed.items()}
