"""What people type: `see2act train`, and the scripts at the top of the repository, which call the same functions."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from see2act.errors import UserError


@contextmanager
def user_errors_end_the_program() -> Iterator[None]:
    """Print the message of a :class:`UserError` on one line, without a traceback, and exit with status 1."""
    try:
        yield
    except UserError as error:
        sys.exit(f"see2act: {error}")
