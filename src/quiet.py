"""Threads, and the advice of libraries that nobody asked for."""

from __future__ import annotations

import logging
import os
import warnings
from typing import Any


def quiet(trainer: Any) -> None:
    """Silence tips and warnings that do not apply here; keep the tools from looking up hosts."""
    del trainer
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    os.environ.setdefault("WANDB_SILENT", "true")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Our data lives in memory, and the interactive loader must not run in a worker.
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*`IterableDataset` has `__len__` defined.*")
