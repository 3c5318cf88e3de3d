"""Writes the measured cells of the tables in README.md and docs/results.md, from the runs in docs/results.

    python -m benchmarks.published

Tables, rows and columns are chosen by hand: add the heading of a column, leave its cells empty, and run this. The heading of a
section names its experiment, as in (`experiment=vision_tasks`). A table whose first cell begins with a primitive is one of
groups; its first column names their sources. A row "*edge* minus scratch" shows differences of two groups.
Other tables are left alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from see2act.analysis.contrasts import compared
from see2act.analysis.groups import Comparison, Found, Group, find
from see2act.analysis.reaching import TARGET, reaching
from see2act.analysis.summary import pooled, published_for, tests
from see2act.files import replacing

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGE = ROOT / "docs" / "results.md"
README = ROOT / "README.md"
FOLDERS = {"robustness objects=random_urdfs": "robustness/random_urdfs"}
"""What a heading says after ``experiment=`` to the folder of results, where they differ."""
OF_README = ("vision_tasks", "transfer_parts")
"""What the README's tables are of."""
TRANSFERS = {"": "full", "backbone and head": "full", "backbone": "backbone", "never fine-tuned": "fixed"}
"""Words after a source to the transfer they mean."""
NETWORKS = {"NanoDet-g": "nanodet_g", "EfficientNet-Lite0": "timm_fpn"}
"""Words in the first cell of a table to the network. It has to be named where an experiment has more than one."""
ATTEMPTS = f"attempts until {TARGET}"
"""The column of medians, which are nothing without their intervals."""
Key = tuple[str, str, str, str]
"""Primitive, task, transfer, and the network, or "" for the only one of the experiment."""
Row = tuple[Comparison, Group]
Groups = Mapping[Key, Row]


def page(text: str) -> tuple[str, dict[str, int]]:
    """``docs/results.md`` with all cells measured, and how many they are by folder of results."""
    sections = text.split("\n## ")
    counts: dict[str, int] = {}
    for place, section in enumerate(sections):
        if "(`experiment=" in section.partition("\n")[0]:
            experiment = section.split("(`experiment=")[1].split("`)")[0]
            folder = FOLDERS.get(experiment, experiment)
            sections[place], counts[folder] = _tables(section, _groups([folder]))
    return "\n## ".join(sections), counts


def readme(text: str) -> tuple[str, dict[str, int]]:
    """The same of ``README.md``, whose tables show rates as means alone."""
    text, count = _tables(text, _groups(OF_README), means=True)
    return text, {README.name: count}


def _groups(folders: Iterable[str]) -> Groups:
    """Groups of the runs in these folders of results; each is one row of a table.

    Raises:
        ValueError: A folder has two groups for one row, or two folders have other runs for it.
    """
    groups: dict[Key, Row] = {}
    for folder in folders:
        known = [(comparison, group) for comparison in _found(folder).comparisons for group in comparison.groups]
        several = len({comparison.protocol["model"] for comparison, _ in known}) > 1
        mine = {_key(comparison, group, several): (comparison, group) for comparison, group in known}
        if len(mine) < len(known):
            raise ValueError(f"docs/results/{folder} has two versions of one condition; keep one of them")
        if other := [key for key in mine.keys() & groups.keys() if _outcomes(mine[key]) != _outcomes(groups[key])]:
            raise ValueError(f"docs/results/{folder} has other runs of {other} than another folder; a table never mixes them")
        groups |= mine
    return groups


def _outcomes(row: Row) -> list[dict[str, Any]]:
    return [run.result.outcomes for run in row[1].runs]


@cache
def _found(folder: str) -> Found:
    return find(RESULTS / folder)


def _tables(text: str, groups: Groups, *, means: bool = False) -> tuple[str, int]:
    lines: list[str] = []
    head: list[str] = []
    count = 0
    for line in text.split("\n"):
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells or not head:
            head = cells
        elif head[0].startswith(("suction", "grasp")) and not set(line) <= set("|- "):
            words, _, others = cells[0].partition(" minus ")
            row, other = _row(groups, head[0], words), _row(groups, head[0], others) if others else None
            shown = [_difference(row, other, column) if other else _cell(*row, column) for column in head[1:]]
            if means:
                shown = [
                    cell if column == ATTEMPTS else cell.split(" ")[0] for column, cell in zip(head[1:], shown, strict=True)
                ]
            cells = [cells[0], *shown]
            line = f"| {' | '.join(cells)} |"
            count += len(shown)
        lines.append(line)
    return "\n".join(lines), count


def _cell(comparison: Comparison, group: Group, column: str) -> str:
    """Text below a heading of a column, empty where such a group has no such number.

    Raises:
        ValueError: The group was not tested then.
    """
    if column.startswith("paper"):
        published = published_for(comparison, group)
        return "" if published is None else f"{published:.2f}"
    if column == ATTEMPTS:
        return _attempts(group)
    counts = _counts(comparison, group, column)
    return _rate(counts) if counts else ""


def _difference(row: Row, other: Row, column: str) -> str:
    """Difference of the mean rates of two groups and its interval, with the verdict if there is one.

    Raises:
        ValueError: Either was not tested then, or not learned, or they have too few seeds.
    """
    a, b = ([successes / attempts for successes, attempts in _counts(*each, column)] for each in (row, other))
    told, (*_, difference, low, high) = compared(a, b) if a and b else ("", (None,) * 3)
    if difference is None:
        raise ValueError(f"{row[1].name} and {other[1].name}: no difference can be shown of {column!r}")
    words = f", {told}" if told in ("better", "worse") else ""
    shown = [f"{number:+.2f}".replace("-0.00", "+0.00") for number in (difference, low, high)]
    return f"{shown[0]} [{shown[1]}, {shown[2]}]{words}"


def _counts(comparison: Comparison, group: Group, column: str) -> list[tuple[int, int]]:
    """Successes and attempts of each seed; none of a group that has no such number, since it does not learn."""
    if column == "while learning":
        return [run.learning for run in group.runs] if group.learned else []
    when, _, split = column.partition(", ")
    step = 0 if when == "before any attempt" else int(when.removeprefix("after "))
    if step and not group.learned:
        return []
    if (counts := tests(group).get((split or "unseen", step))) is None:
        raise ValueError(f"{comparison.name}, {group.name}: not all seeds were tested {column!r}")
    return counts


def _row(groups: Groups, head: str, words: str) -> Row:
    """What the words mean in a table with this first cell.

    Raises:
        ValueError: No runs of it are kept.
    """
    if (source := _source(head, words)) not in groups:
        raise ValueError(f"no runs are kept of this row of the table {head!r}: {words}")
    return groups[source]


def _source(head: str, words: str) -> Key:
    """Of the row that begins with these words, in the table with this first cell."""
    primitive = "suction" if head.startswith("suction") else "grasp"
    network = next((network for name, network in NETWORKS.items() if name in head), "")
    if words == "scratch":
        return primitive, "none", "none", network
    source, _, transfer = words.partition(", ")
    if transfer not in TRANSFERS:
        raise ValueError(f"the row {words!r} of the table {head!r} ends with none of {', '.join(filter(None, TRANSFERS))}")
    return primitive, source.strip("*"), TRANSFERS[transfer], network


def _key(comparison: Comparison, group: Group, several: bool) -> Key:
    network = comparison.protocol["model"] if several else ""
    return comparison.primitive.removesuffix("_rg2"), group.task, group.transfer, network


def _rate(counts: list[tuple[int, int]]) -> str:
    """Mean over seeds of successes/attempts, its interval, and the sums."""
    mean, interval, successes, attempts = pooled(counts)
    limits = f"[{interval[0]:.2f}, {interval[1]:.2f}] " if interval else ""
    return f"{mean:.2f} {limits}({successes}/{attempts})"


def _attempts(group: Group) -> str:
    found = reaching(group)
    if not found:
        return ""
    limits = f" [{', '.join(map(found.text, found.interval))}]" if found.interval else ""
    return f"{found.text(found.median)}{limits} ({found.reached} of {len(group.runs)})"


def main() -> None:
    """Fill the tables of both files."""
    for path, fill in ((PAGE, page), (README, readme)):
        text, counts = fill(path.read_text())
        with replacing(path) as partial:
            partial.write_text(text)
        print(f"{path.relative_to(ROOT)}: {sum(counts.values())} cells")


if __name__ == "__main__":
    main()
