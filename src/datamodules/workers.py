"""Processes that must not outlive the one that started them."""

from __future__ import annotations

import os
import threading
import time
from functools import cache

POLL = 0.5
"""Seconds between two looks at whether the parent is there."""


@cache  # once a process, however often it is called
def end_with_parent() -> None:
    """End this process soon after the one that started it, however that one ends.

    A process that is killed cannot end its workers. They would go on, and keep the folder of a run to themselves.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
