"""Things that are expensive to make and depend on nothing but their configuration: made once, kept by hash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from filelock import FileLock


def once(path: Path, make: Callable[[], None]) -> bool:
    """Call ``make``, which must write ``path`` atomically, unless the file is there.

    Of several processes that need the same file at the same time one makes it and the others wait.

    Returns:
        Whether it was made now.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if path.exists():
            return False
        make()
        if not path.exists():
            raise RuntimeError(f"nothing was written to {path}")
        return True
