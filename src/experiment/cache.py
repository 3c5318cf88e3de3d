"""Files that are expensive to make and depend on nothing but their configuration: made once, kept by hash."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from see2act.errors import DamagedFile

log = logging.getLogger("see2act")
T = TypeVar("T")


def once(path: Path, make: Callable[[], None], load: Callable[[Path], T]) -> tuple[T, bool]:
    """What ``load`` reads from a file that ``make`` writes unless it is there.

    Of several processes that need the same file at the same time one makes it and the others wait. A file that is damaged, by
    a disk that failed or a copy that was cut short, is made again.

    Args:
        path: The file.
        make: Must write it atomically.
        load: Reads it; raises :class:`~see2act.errors.DamagedFile` where it is not what ``make`` wrote.

    Returns:
        What was read, and whether the file was made now.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone_at(path):
        made = not path.exists()
        if made:
            _make(path, make)
    try:
        return load(path), made
    except DamagedFile:
        if made:
            raise
    with _alone_at(path):
        try:
            return load(path), False  # another process has made it again meanwhile
        except DamagedFile as error:
            log.warning("%s is damaged, and is made again: %s", path, error)
        path.unlink()
        _make(path, make)
        return load(path), True


@contextmanager
def _alone_at(path: Path) -> Iterator[None]:
    lock = FileLock(f"{path}.lock")
    try:
        lock.acquire(timeout=1)
    except Timeout:
        log.info("waiting for another process, which is making %s", path)
        lock.acquire()
    try:
        for partial in path.parent.glob(f".{path.name}.*.partial"):  # of a process that was killed while it wrote
            partial.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def _make(path: Path, make: Callable[[], None]) -> None:
    make()
    if not path.exists():
        raise RuntimeError(f"nothing was written to {path}")
