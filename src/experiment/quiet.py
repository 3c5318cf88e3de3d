"""Threads, and the advice of libraries that nobody asked for."""

from __future__ import annotations

import logging
import os
import warnings


def quiet() -> None:
    """Silence tips and warnings that do not apply here; keep the tools from looking up hosts."""
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    os.environ.setdefault("WANDB_SILENT", "true")
    logging.raiseExceptions = False  # a full disk would make each message that train.log has no room for a traceback
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("timm.models").setLevel(logging.ERROR)  # a backbone has no use for a classifier's last layer
    # Our data lives in memory, and the interactive loader must not run in a worker.
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*module\\(s\\) in eval mode.*")  # frozen BatchNorm is intended
    warnings.filterwarnings("ignore", message=".*LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*`srun` command is available.*")  # a run is one process, on a cluster too
    warnings.filterwarnings("ignore", message=".*`IterableDataset` has `__len__` defined.*")
