"""Every measurement of time in one table, each beside the plain way to do the same (``make bench``)."""

from __future__ import annotations

from typing import Any

from benchmarks import loop, stages, sweep
from benchmarks.common import timed


def rows(overrides: list[str], repeats: int) -> list[dict[str, Any]]:
    """Stages, the loop, a sweep."""
    return [row for part in (stages, loop, sweep) for row in part.rows(overrides, repeats)]


if __name__ == "__main__":
    timed(__doc__, "Speed", rows)
