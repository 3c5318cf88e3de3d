"""Errors that a user can fix."""

from __future__ import annotations


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


class DamagedFile(UserError, ValueError):
    """A file that is not what this project wrote."""


class TransferError(UserError, ValueError):
    """Weights that do not fit the network, or cannot be read."""


class MissingWeights(TransferError):
    """Off-the-shelf weights that are not on this machine and cannot be downloaded. A sweep goes on without them."""
