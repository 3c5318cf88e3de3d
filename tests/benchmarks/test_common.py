from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

POOL = "import os; from benchmarks.common import pool_of; pool = pool_of(1); print(pool.submit(os.getpid).result(), flush=True)"


def test_workers_end_when_their_parent_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", f"{POOL}; input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout
        worker = Path("/proc", parent.stdout.readline().decode().strip(), "cmdline")
        assert worker.read_bytes()
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        end = time.monotonic() + 30
        while worker.exists() and worker.read_bytes():  # empty: a zombie
            assert time.monotonic() < end, "the worker lives on"
            time.sleep(0.05)
