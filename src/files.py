"""Writing so that a file is there whole or not at all."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from see2act.errors import DamagedFile

HOST = platform.node()
"""Of several that write to one disk."""


def writable(folder: Path) -> bool:
    """Whether a folder may be written to, or made."""
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    return existing.is_dir() and os.access(existing, os.W_OK)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends without an error.

    Raises:
        OSError: It cannot be written. The error names ``path``.
    """
    partial = path.with_name(f".{path.name}.{HOST}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(f".{escape(path.name)}.{escape(HOST)}.*.partial"):
            if not _lives(int(left.name.split(".")[-2])):  # it was killed while it wrote the same file
                left.unlink(missing_ok=True)
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())  # or a machine that loses its power may keep the name and lose what is in the file
        os.replace(partial, path)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # a full disk is found by a write, which knows no name
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


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
        raise damaged(path, error) from None


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Arrays that :func:`write_arrays` wrote. Nothing in the file is executed.

    Raises:
        DamagedFile: It is no such file, or lacks one of ``names``.
        FileNotFoundError: It is not there.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, zlib and numpy each have their own
        raise damaged(path, error) from None


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, compressed, atomically."""
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def damaged(path: Path, error: Exception) -> DamagedFile:
    """The error of a file that is not what this project wrote."""
    reason = " ".join(str(error).split())[:160] or type(error).__name__
    return DamagedFile(f"{path} is damaged ({reason}): delete it and type the same command again")


def write_json(path: Path, data: object) -> None:
    """Write indented JSON atomically."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(data, indent=2) + "\n")
