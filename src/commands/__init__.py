"""What people type: `see2act train`, and the scripts at the top of the repository, which call the same functions."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TextIO, cast

from see2act.errors import UserError, storage_errors


class Unread:
    """Standard output that may be closed at its other end, as by ``| head``: the work goes on, and is not read.

    Args:
        stream: What it writes to until then.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop what nobody reads."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._drop()
            return len(text)

    def flush(self) -> None:
        """Flush, or drop what nobody reads."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop()

    def _drop(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())  # for the programs that this one starts, too
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def user_errors_end_the_program() -> Iterator[None]:
    """Print the message of a :class:`UserError` on one line, without a traceback, and exit with status 1.

    A disk that is full, or a folder that may not be written, counts as one. So do Ctrl-C, and a worker process that was killed.

    From here on, standard output may be closed by its reader.
    """
    if not isinstance(sys.stdout, Unread):
        sys.stdout = cast(TextIO, Unread(sys.stdout))
    try:
        with storage_errors():
            yield
    except UserError as error:
        sys.exit(f"see2act: {error}")
    except BrokenProcessPool:
        sys.exit(
            "see2act: something ended a worker process, perhaps the system because memory ran out: type the same command "
            "again, with fewer workers (hydra.launcher.n_jobs=1, collect.workers=1) if it is short of memory"
        )
    except KeyboardInterrupt:  # and SIGTERM in a run
        print("see2act: interrupted: type the same command again to go on", file=sys.stderr)
        sys.exit(130)  # as shells say that a program was interrupted
