"""Files that are expensive to make and depend on nothing but their configuration: made once, kept by hash."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger("see2act")


def once(path: Path, make: Callable[[], None]) -> bool:
    """Call ``make``, which must write ``path`` atomically, unless the file is there.

    Of several processes that need the same file at the same time one makes it and the others wait.

    Returns:
        Whether it was made now.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{path}.lock")
    try:
        lock.acquire(timeout=1)
    except Timeout:
        log.info("waiting for another process, which is making %s", path)
        lock.acquire()
    try:
        for partial in path.parent.glob(f".{path.name}.*.partial"):  # of a process that was killed while it wrote
            partial.unlink(missing_ok=True)
        if path.exists():
            return False
        make()
        if not path.exists():
            raise RuntimeError(f"nothing was written to {path}")
        return True
    finally:
        lock.release()
