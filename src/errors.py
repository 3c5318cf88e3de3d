"""Errors that a user can fix."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
"""Errors of files for which the code cannot do anything: no room, or no permission."""


class UserError(Exception):
    """Something that a user gave cannot be used. The message is one line and says what to do about it.

    Every command prints the message and ends. Anything else that is raised is a bug.
    """


class ConfigError(UserError, ValueError):
    """A configuration that cannot run."""


class DivergedError(UserError, ArithmeticError):
    """A network whose outputs are no longer finite."""

    def __init__(self, what: str):
        super().__init__(f"{what}: the network has diverged: lower finetune.backbone_lr and finetune.head_lr")


class StorageError(UserError):
    """A file that cannot be written, since the disk is full or the folder is another's."""


@contextmanager
def storage_errors() -> Iterator[None]:
    """Make a :class:`StorageError` of an ``OSError`` that says that there is no room or no permission."""
    try:
        yield
    except OSError as error:
        if error.errno not in STORAGE:
            raise
        mend = (
            "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "make it writable, or choose another folder"
        )
        what = f"{error.filename} cannot be written" if error.filename else "a file cannot be written"
        raise StorageError(f"{what} ({error.strerror}): {mend}, and type the same command again") from error


class DamagedFile(UserError, ValueError):
    """A file that is not what this project wrote."""


class TransferError(UserError, ValueError):
    """Weights that do not fit the network, or cannot be read."""


class MissingWeights(TransferError):
    """Off-the-shelf weights that are not on this machine and cannot be downloaded. A sweep goes on without them."""
