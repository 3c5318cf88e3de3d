"""The published tables are what the committed runs say."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from see2act.analysis import summary
from see2act.analysis.groups import find

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
SOURCES = {"": "full", "backbone and head": "full", "backbone": "backbone", "never fine-tuned": "fixed"}
"""Words after a source to the transfer they mean."""
MODELS = {"NanoDet-g": "nanodet_g", "EfficientNet-Lite0": "timm_fpn"}
"""Words in the head of a table to the network, where a page shows more than one."""
NUMBERS = re.compile(r"([\d.]+)(?: \[(-?[\d.]+), (-?[\d.]+)\])?(?: \((\d+)/(\d+)(?:, all seeds the same)?\))?")


class Cell(NamedTuple):
    """One cell of a published table, and where it stands."""

    place: str
    model: str
    primitive: str
    source: tuple[str, str]
    column: str
    text: str


def _tables(path: Path, after: str, before: str = "\n## ", model: str = "") -> Iterator[Cell]:
    """Cells of all tables of groups between two headings; ``model`` is that of tables which do not name one."""
    header: list[str] = []
    section = path.read_text().split(after)[1].split(before)[0]
    for line in section.splitlines():
        if not line.startswith("|") or set(line) <= set("|- "):
            header = header if line.startswith("|") else []
            continue
        first, *cells = (cell.strip().replace("**", "") for cell in line.strip("|").split("|"))
        if not header:
            header = [first, *cells]
            continue
        task, _, words = first.partition(", ")
        source = ("none", "none") if task == "scratch" else (task.strip("*"), SOURCES[words])
        primitive = "suction" if header[0].startswith("suction") else "grasp"
        network = next((key for words, key in MODELS.items() if words in header[0]), model)
        for column, text in zip(header[1:], cells, strict=True):
            yield Cell(f"{path.name}: {header[0]}, {first}, {column}", network, primitive, source, column, text)


NETWORKS = {
    **{"vision_tasks": "fcn7", "transfer_parts": "fcn7", "off_the_shelf": "rpn_r50_fpn"},
    **{"off_the_shelf_small": "nanodet_g", "off_the_shelf_small_real": "nanodet_g"},
    **{"off_the_shelf_small_floor": "nanodet_g", "robustness/random_urdfs": "fcn7"},
}
"""Of the experiments whose tables do not name one."""
SETTINGS = {"robustness/random_urdfs": "robustness objects=random_urdfs"}
"""What stands in the heading for a folder that is not named like its experiment."""
TABLES = {
    folder: [*_tables(RESULTS.with_suffix(".md"), f"(`experiment={SETTINGS.get(folder, folder)}`)", model=model)]
    for folder, model in NETWORKS.items()
}


LEAST = {
    **{"vision_tasks": 80, "transfer_parts": 30, "off_the_shelf": 10},
    **{"off_the_shelf_small": 55, "off_the_shelf_small_real": 18},
    **{"off_the_shelf_small_floor": 14, "robustness/random_urdfs": 12},
}
"""Cells that a page with all of its tables has."""


def _arm(row: dict[str, str]) -> tuple[str, str, tuple[str, str]]:
    return row["model"], row["primitive"].removesuffix("_rg2"), (row["task"], row["transfer"])


@pytest.fixture(scope="module", params=TABLES)
def published(request: pytest.FixtureRequest) -> tuple[list[Cell], dict, dict]:
    """Cells of an experiment's tables, its groups by primitive and source, and their success by step and split."""
    assert len(TABLES[request.param]) >= LEAST[request.param]
    found = find(RESULTS / request.param)
    groups = {_arm(row): row for row in summary.rows(found) if row["config_hash"]}
    progress = [row for comparison in found.comparisons for row in summary.progress(comparison)]
    steps = {(*_arm(row), row["step"], row["split"]): row for row in progress}
    return TABLES[request.param], groups, steps


def test_every_number_of_the_tables_is_in_the_committed_runs(published: tuple[list[Cell], dict, dict]) -> None:
    cells, groups, steps = published
    for cell in cells:
        group = groups[cell.model, cell.primitive, cell.source]
        if not cell.text and cell.source[1] == "fixed":
            continue  # it is not fine-tuned
        if cell.column.startswith("paper"):
            assert cell.text in ("", group["paper_unseen"]), cell.place
            continue
        if cell.column == "while learning":
            row = {part: group[f"learning_{part}"] for part in summary.PARTS}
        else:
            when, _, split = cell.column.partition(", ")
            step = "0" if when.startswith("before") else when.removeprefix("after ")
            row = steps[cell.model, cell.primitive, cell.source, step, split or "unseen"]
        match = NUMBERS.fullmatch(cell.text)
        assert match, cell.place
        mean, low, high, successes, attempts = match.groups()
        for shown, measured in ((mean, row["mean"]), (low, row["low"]), (high, row["high"])):
            assert shown is None or abs(float(shown) - float(measured)) < 0.0056, (cell.place, shown, measured)
        assert successes is None or (successes, attempts) == (row["successes"], row["attempts"]), cell.place


def test_the_readme_shows_the_same_numbers() -> None:
    simulation = TABLES["transfer_parts"] + TABLES["vision_tasks"]
    of_docs = {cell[1:5]: cell.text.split(" ")[0] for cell in simulation}
    readme = [*_tables(ROOT / "README.md", "## What it found", model="fcn7")]
    assert len(readme) > 20
    for cell in readme:
        column = "paper, after" if cell.column == "paper" else cell.column
        assert cell.text == of_docs[cell.model, cell.primitive, cell.source, column], cell.place
