"""Tables and figures of all runs in a folder, with the paper's numbers beside ours.

Writes report.html (one file, nothing else needed), table.csv, table.md, progress.csv (success on the way) and figures/ into
the folder. What cannot be averaged is kept apart, and said: here, and at the top of the page.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from see2act.analysis.groups import Found, find
from see2act.commands import user_errors_end_the_program
from see2act.errors import UserError

HINT = "give a folder that holds runs of train.py, such as outputs or multirun/sweep"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR", help="searched for runs, with all folders in it")
    words = "also copy there what the report is made from, small enough for a repository"
    parser.add_argument("--keep", type=Path, metavar="OUT", help=words)
    args = parser.parse_args(arguments)
    with user_errors_end_the_program():
        if args.keep:
            _check_keep(args.keep, args.folder)
        try:
            found = report(args.folder)
            if args.keep:
                from see2act.analysis.keep import keep  # brings matplotlib, too

                keep(found, args.keep)
        except PermissionError as error:
            raise UserError(
                f"{error.filename} cannot be read or written: make it yours, or copy the runs to a folder of your own"
            ) from None
    for notice in found.notices:
        print(f"NOTE  {notice}")
    for name in ("report.html", "table.csv", "table.md", "progress.csv", "figures"):
        print(args.folder / name)


def _check_keep(keep: Path, folder: Path) -> None:
    if keep.exists() and not keep.is_dir():
        raise UserError(f"--keep {keep} is a file: give a folder")
    if keep.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"--keep {keep} lies in {folder}, whose report would then find each run twice: give another folder")


def report(folder: Path) -> Found:
    """Write the report of all runs below ``folder`` into it.

    Raises:
        UserError: There is no such folder, or no run in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder: {HINT}")
    found = find(folder)
    if not (found.comparisons or found.unfinished or found.broken):
        raise UserError(f"{folder} holds no runs: {HINT}, or make one with `python train.py`")
    from tqdm import tqdm

    from see2act.analysis import markdown, page, plots, summary  # matplotlib takes a second, which a refusal should not

    rows = summary.rows(found)
    summary.write_csv(rows, folder / "table.csv")
    steps = [line for comparison in found.comparisons for line in summary.progress(comparison)]
    markdown.write(rows, steps, folder / "table.md")
    summary.write_csv(steps, folder / "progress.csv", summary.PROGRESS_COLUMNS)
    pictures: dict[str, list[plots.Picture]] = {}
    with tqdm(total=len(found.comparisons) * len(plots.FIGURES), desc="draw", disable=None) as bar:
        for comparison in found.comparisons:
            pictures[comparison.slug] = []
            for picture in plots.draw(comparison, folder / "figures"):
                pictures[comparison.slug].append(picture)
                bar.update()
    plots.clear(folder / "figures", [picture for drawn in pictures.values() for picture in drawn])
    page.write(found, rows, steps, pictures, folder)
    return found
