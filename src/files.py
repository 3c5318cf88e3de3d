"""Writing so that a file is there whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from see2act.errors import DamagedFile


def writable(folder: Path) -> bool:
    """Whether a folder may be written to, or made."""
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    return existing.is_dir() and os.access(existing, os.W_OK)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def sweep_up(folder: Path) -> None:
    """Remove what processes that were killed while writing left in a folder and in those in it; nobody may be at work there.

    No deeper: a run's folder may be one that holds others, or the cache.
    """
    for pattern in (".*.partial", "*/.*.partial"):
        for partial in folder.glob(pattern):
            partial.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """What :func:`write_json` wrote.

    Raises:
        DamagedFile: It is no JSON.
    """
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise DamagedFile(
            f"{path} is damaged ({' '.join(str(error).split())}): delete it and type the same command again"
        ) from None


def write_json(path: Path, data: object) -> None:
    """Write indented JSON atomically."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(data, indent=2) + "\n")
