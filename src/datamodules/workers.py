"""Worker processes, which must not outlive the process that started them."""

from __future__ import annotations

import os
import threading
import time
from functools import cache
from multiprocessing import parent_process

POLL = 0.5
"""Seconds between two looks at whether the parent is there."""


@cache  # once a process, however often it is called
def end_with_parent() -> None:
    """End this process soon after the one that started it, however that one ends. In a main process it does nothing.

    A process that is killed cannot end its workers. They would go on, and keep the folder of a run to themselves.
    """
    parent = parent_process()
    if parent is None:
        return
    pid = parent.pid  # as the parent said: os.getppid() is another process's by now if the parent has ended already

    def watch() -> None:
        while os.getppid() == pid:
            time.sleep(POLL)
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
