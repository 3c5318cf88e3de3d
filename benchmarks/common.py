"""What the measurements share: their command line, worker processes, and tables."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path
from statistics import median
from threading import Thread
from time import process_time
from typing import Any

from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from see2act.errors import ConfigError
from see2act.experiment.checks import validate
from see2act.experiment.config import composed
from see2act.files import write_json

PRIMITIVES = ("suction", "grasp")
Work = Callable[[], Any]


def arguments(description: str | None, workers: bool = True) -> argparse.ArgumentParser:
    """A parser with the options that all measurements have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    if workers:
        parser.add_argument("--workers", type=at_least_one, default=2, metavar="N", help="processes (default 2)")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py")
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """What was typed, overrides checked: ends the program with one line where one of them does not exist."""
    args = parser.parse_args()
    try:
        validate(composed(args.overrides))
    except ConfigError as error:
        parser.error(str(error))
    return args


def at_least_one(text: str) -> int:
    """A count on the command line."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"{count} is too small: at least 1")
    return count


def spread(function: Callable[..., Any], jobs: Sequence[tuple], workers: int, title: str) -> Iterator[Any]:
    """Results of ``function(*job)`` for each job, in order, from processes of their own."""
    with pool_of(workers) as pool:
        yield from tqdm(pool.map(function, *zip(*jobs, strict=True)), total=len(jobs), desc=title)


def pool_of(workers: int) -> ProcessPoolExecutor:
    """Processes that end when this one does, however it ends."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    Thread(target=watch, daemon=True).start()


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


def race(ours: Work, plain: Work, repeats: int) -> tuple[float, float]:
    """Median processor seconds of both, taken in turns after a warm-up; one thread, so load elsewhere matters little."""
    times: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats + 1):
        for work, seconds in zip((ours, plain), times, strict=True):
            start = process_time()
            work()
            if repeat:
                seconds.append(process_time() - start)
    return median(times[0]), median(times[1])


def faster(name: str, seconds: float, naive: float, target: float | None) -> dict[str, Any]:
    """A row that says how many times faster than the plain way something is, at least."""
    ratio = naive / seconds
    return _row(name, seconds, naive, ratio, f">= {target:g}" if target else "", ratio >= target if target else None)


def overhead(name: str, seconds: float, naive: float, target: float | None) -> dict[str, Any]:
    """A row that says how many times as long as its bare core something takes, at most."""
    ratio = seconds / naive
    return _row(name, seconds, naive, ratio, f"<= {target:g}" if target else "", ratio <= target if target else None)


def _row(name: str, seconds: float, naive: float | None, ratio: float | None, target: str, met: bool | None) -> dict[str, Any]:
    return {"name": name, "seconds": seconds, "naive_seconds": naive, "ratio": ratio, "target": target, "met": met}


def not_here(name: str) -> dict[str, Any]:
    """A row for what this processor cannot do."""
    unknown = dict.fromkeys(("seconds", "naive_seconds", "ratio", "target"))
    return {"name": name, **unknown, "met": "n/a: this processor does not compute in bfloat16"}


def limit(name: str, seconds: float, most: float) -> dict[str, Any]:
    """A row for a time in seconds that has no plain twin."""
    return _row(name, seconds, None, None, f"<= {most:g} s", seconds <= most)


def measured(name: str, seconds: float) -> dict[str, Any]:
    """A row for a time in seconds that has neither a plain twin nor a target."""
    return _row(name, seconds, None, None, "", None)


def timed(description: str | None, title: str, rows: Callable[[list[str], int], Iterable[dict[str, Any]]]) -> None:
    """The command of a measurement of time: ``rows(overrides, repeats)``, each told as it comes, then printed and written."""
    parser = arguments(description, workers=False)
    parser.add_argument(
        "--repeats", type=at_least_one, default=9, metavar="N", help="of what is fast; fewer of the rest (default 9)"
    )
    args = parsed(parser)
    table = []
    for row in rows(args.overrides, args.repeats):
        table.append(row)
        print(row, file=sys.stderr, flush=True)
    finish(title, table, args.json)
