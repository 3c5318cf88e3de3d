"""Errors that a user can fix."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
"""Errors of files for which the code cannot do anything: no room, or no permission."""
NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR)
"""Errors of paths at which there can be no such file."""


class UserError(Exception):
    """Something that a user gave cannot be used. The message is one line and says what to do about it.

    Every command prints the message and ends. Anything else that is raised is a bug.

    Args:
        message: Line breaks in it, as in the name of a file or in what another library says, become spaces.
    """

    def __init__(self, message: str):
        super().__init__(" ".join(message.splitlines()))


class ConfigError(UserError, ValueError):
    """A configuration that cannot run."""


class DivergedError(UserError, ArithmeticError):
    """A network whose outputs are no longer finite."""

    def __init__(self, what: str):
        super().__init__(f"{what}: the network has diverged: lower finetune.backbone_lr and finetune.head_lr")


class StorageError(UserError):
    """A file that cannot be, since the disk is full, the folder is another's, or its path is none."""


@contextmanager
def storage_errors() -> Iterator[None]:
    """Make a :class:`StorageError` of an ``OSError`` that says that there is no room, no permission, or no such path."""
    try:
        yield
    except OSError as error:
        if error.errno in NAMES and error.filename:
            raise StorageError(f"{error.filename} cannot be there ({error.strerror}): give another path") from error
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
