"""Every measurement of time in one table, each beside the plain way to do the same (``make bench``)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks import loop, stages, sweep
from benchmarks.common import timed


def rows(overrides: list[str], repeats: int) -> Iterator[dict[str, Any]]:
    """Stages, the loop, a sweep."""
    for part in (stages, loop, sweep):
        yield from part.rows(overrides, repeats)


if __name__ == "__main__":
    timed(__doc__, "Speed", rows)
