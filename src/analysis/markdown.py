"""The tables that a reader looks for first, in Markdown: to paste into a README or an issue."""

from __future__ import annotations

from pathlib import Path

from see2act.analysis.reaching import TARGET
from see2act.analysis.summary import PARTS, Row
from see2act.files import replacing

MEASURES = {
    "after, unseen": "after_unseen",
    "after, seen": "after_seen",
    "zero-shot, unseen": "zero_shot_unseen",
    "zero-shot, seen": "zero_shot_seen",
}
"""Heads of columns, and what stands below."""
EXPLANATION = "Mean over seeds [95 % t interval] (successes/attempts)."
ON_THE_WAY = (
    f"After how many attempts success on unseen objects is {TARGET}: median over seeds [its exact 95 % interval] (seeds that "
    "reached it)."
)


def write(rows: list[Row], steps: list[Row], path: Path) -> None:
    """A table of all groups, and of each comparison one of its groups' success on unseen objects on the way.

    Args:
        rows: Of ``table.csv``.
        steps: Of ``progress.csv``.
        path: The file.
    """
    text = [*_table(rows), "", EXPLANATION]
    for comparison in dict.fromkeys(map(_comparison, steps)):
        name = ", protocol ".join(filter(None, comparison))
        mine = [row for row in rows if _comparison(row) == comparison and row["config_hash"]]
        unseen = [step for step in steps if _comparison(step) == comparison and step["split"] == "unseen"]
        heading, words = f"## Success on unseen objects on the way: {name}", f"{EXPLANATION} {ON_THE_WAY}"
        text += ["", heading, "", *_progress(mine, unseen), "", words]
    with replacing(path) as partial:
        partial.write_text("\n".join(text) + "\n")


def _table(rows: list[Row]) -> list[str]:
    text = _head(["primitive", "source", "transfer", "configuration", "seeds", "paper, unseen", *MEASURES, "note"])
    for row in rows:
        measured = [_rate(row, f"{measure}_") for measure in MEASURES.values()]
        text.append(_line([row["primitive"], *_group(row), row["seeds"], row["paper_unseen"], *measured, row["note"]]))
    return text


def _progress(rows: list[Row], steps: list[Row]) -> list[str]:
    cells = {(step["config_hash"], int(step["step"])): _rate(step) for step in steps}
    at = sorted({step for _, step in cells})
    heads = ["before" if step == 0 else f"after {step}" for step in at]
    text = _head(["source", "transfer", "configuration", *heads, "while learning", f"attempts until {TARGET}"])
    for row in rows:
        tested = [cells.get((row["config_hash"], step), "") for step in at]
        text.append(_line([*_group(row), *tested, _rate(row, "learning_"), _reach(row)]))
    return text


def _comparison(row: Row) -> tuple[str, str]:
    """What rows of one comparison share."""
    return row["primitive"], row["protocol"]


def _group(row: Row) -> list[str]:
    """Source, transfer and configuration."""
    protocol = f"protocol {row['protocol']}," if row["protocol"] else ""
    hashed = f"`{row['config_hash']}`" if row["config_hash"] else ""
    return [row["task"], row["transfer"], " ".join(filter(None, (row["model"], protocol, hashed, row["differs"])))]


def _rate(row: Row, prefix: str = "") -> str:
    mean, low, high, successes, attempts, *_ = (row[f"{prefix}{part}"] for part in PARTS)
    if not mean:
        return ""
    return f"{mean} {f'[{low}, {high}] ' if low else ''}({successes}/{attempts})"


def _reach(row: Row) -> str:
    if not row["reach_median"]:
        return ""
    interval = f" [{row['reach_low']}, {row['reach_high']}]" if row["reach_low"] else ""
    return f"{row['reach_median']}{interval} ({row['reach_seeds']} of {len(row['seeds'].split())})"


def _head(cells: list[str]) -> list[str]:
    return [_line(cells), "|" + "---|" * len(cells)]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
