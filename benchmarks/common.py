"""What the measurements share: their command line, worker processes, and tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from see2act.files import write_json
from tqdm import tqdm

PRIMITIVES = ("suction", "grasp")


def arguments(description: str | None, workers: bool = True) -> argparse.ArgumentParser:
    """A parser with the options that all measurements have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    if workers:
        parser.add_argument("--workers", type=at_least_one, default=2, metavar="N", help="processes (default 2)")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py")
    return parser


def at_least_one(text: str) -> int:
    """A count on the command line."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"{count} is too small: at least 1")
    return count


def spread(function: Callable[..., Any], jobs: Sequence[tuple], workers: int, title: str) -> Iterator[Any]:
    """Results of ``function(*job)`` for each job, in order, from processes of their own."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from tqdm(pool.map(function, *zip(*jobs, strict=True)), total=len(jobs), desc=title)


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    table = Table(title=title)
    for name in rows[0]:
        table.add_column(name)
    for row in rows:
        table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(file=sys.stdout, width=140).print(table)


def finish(title: str, rows: list[dict[str, Any]], path: Path | None) -> None:
    """Print rows as a table and write them where ``--json`` says."""
    show(title, rows)
    if path:
        write_json(path, rows)
