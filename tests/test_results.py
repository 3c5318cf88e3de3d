"""The published tables are what the committed runs say."""

from __future__ import annotations

import re

import pytest

from benchmarks import published
from see2act.analysis.contrasts import compared
from see2act.analysis.summary import rates

LEAST = {
    **{"vision_tasks": 80, "transfer_parts": 30, "off_the_shelf": 30},
    **{"off_the_shelf_small": 55, "off_the_shelf_small_real": 20},
    **{"off_the_shelf_small_floor": 15, "robustness/random_urdfs": 20},
    **{"ten_seeds/vision_tasks": 110, "ten_seeds/transfer_parts": 40},
}
"""Cells that a page with all of its tables has, by folder of results."""


def test_every_number_of_the_tables_is_what_the_committed_runs_say() -> None:
    text = published.PAGE.read_text()
    filled, counts = published.page(text)
    assert filled == text, "run python -m benchmarks.published"
    assert counts.keys() == LEAST.keys()
    assert all(counts[folder] >= least for folder, least in LEAST.items()), counts
    kept = {path.parents[5] for path in published.RESULTS.rglob("result.json")}
    assert {str(path.relative_to(published.RESULTS)) for path in kept} == LEAST.keys()


def test_the_readme_shows_the_same_means() -> None:
    text = published.README.read_text()
    filled, counts = published.readme(text)
    assert filled == text, "run python -m benchmarks.published"
    assert sum(counts.values()) > 20


def test_the_readme_shows_medians_with_their_intervals() -> None:
    table = "| grasp, from | attempts until 0.8 | after 400 |\n|---|---|---|\n| *edge* | | |\n"
    row = published.readme(table)[0].split("\n")[2]
    assert re.fullmatch(r"\| \*edge\* \| (> )?\d+( \[.+\])? \(\d+ of \d+\) \| \d\.\d\d \|", row)


def test_a_wrong_number_is_mended_and_a_row_without_runs_refused() -> None:
    head, rule = "## Tasks (`experiment=vision_tasks`)\n\n| suction | after 60, seen | attempts until 0.8 |", "|---|---|---|"
    row = "| scratch | 1.00 (1/1) | |"
    filled, counts = published.page(f"# Results\n\n{head}\n{rule}\n{row}\n\n| rule | unseen |\n|---|---|\n| suction | 0.1 |\n")
    assert counts == {"vision_tasks": 2}
    first, second = filled.split("\n")[6].strip("| ").split(" | ")[1:]
    group = next(
        group
        for comparison in published.find(published.RESULTS / "vision_tasks").comparisons
        for group in comparison.groups
        if (group.primitive, group.task) == ("suction", "none")
    )
    points = [next(point for point in run.result.evals if point.step == 60).seen for run in group.runs]
    rates = [point.success_rate for point in points]
    assert first.startswith(f"{sum(rates) / len(rates):.2f} [")
    assert first.endswith(f"({sum(point.successes for point in points)}/{sum(point.attempts for point in points)})")
    assert second.endswith(f"of {len(rates)})")
    assert "| suction | 0.1 |" in filled
    with pytest.raises(ValueError, match="no runs are kept of this row"):
        published.page(f"# Results\n\n{head}\n{rule}\n{row.replace('scratch', '*shadow*')}\n")
    with pytest.raises(ValueError, match="not all seeds were tested 'after 61'"):
        published.page(f"# Results\n\n{head.replace('60, seen', '61')}\n{rule}\n{row}\n")


def test_a_row_of_two_groups_shows_their_difference_and_its_verdict() -> None:
    head, rule = "## Tasks (`experiment=vision_tasks`)\n\n| grasp | while learning | after 400 |", "|---|---|---|"
    rows = "| *center* minus scratch | | |\n| *corner* minus scratch | | |"
    filled, counts = published.page(f"# Results\n\n{head}\n{rule}\n{rows}\n")
    assert counts == {"vision_tasks": 4}
    cells = [line.strip("| ").split(" | ")[1:] for line in filled.split("\n")[6:8]]
    comparison = next(
        comparison
        for comparison in published.find(published.RESULTS / "vision_tasks").comparisons
        if comparison.primitive == "grasp"
    )
    groups = {group.task: group for group in comparison.groups}
    for task, row in zip(("center", "corner"), cells, strict=True):
        for measure, cell in zip(("learning", "after_unseen"), row, strict=True):
            told, (*_, difference, low, high) = compared(rates(groups[task], measure), rates(groups["none"], measure))
            words = f", {told}" if told in ("better", "worse") else ""
            assert cell == f"{difference:+.2f} [{low:+.2f}, {high:+.2f}]{words}"
    with pytest.raises(ValueError, match="no runs are kept of this row"):
        published.page(f"# Results\n\n{head}\n{rule}\n| *center* minus shadow | | |\n")
