"""How much a sweep gains from a second worker: the same jobs with one and with two, each job on one thread."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from benchmarks.common import faster, timed

JOBS = 8
SMALL = (
    *("task=none", "transfer=none", "primitive=suction", "collect.interactions=20", "figures.scenes=1", "logger=none"),
    *("finetune.attempts=15", "evaluate.at=[0]", "evaluate.attempts={seen: 4, unseen: 4}", "hydra.sweep.dir=sweep"),
)


def rows(overrides: list[str], repeats: int) -> list[dict[str, Any]]:
    """One row: seconds with two workers, and with one."""
    with TemporaryDirectory() as scratch:
        seconds: list[float] = []
        for workers in (1, 2, 1):  # the first also fills the cache
            jobs = JOBS if seconds else 1
            start = perf_counter()
            _sweep(Path(scratch) / f"{len(seconds)}", Path(scratch) / "cache", workers, jobs, overrides)
            seconds.append(perf_counter() - start)
    _, two, one = seconds
    return [faster(f"sweep of {JOBS} jobs with two workers, against one", two, one, 1.9)]


def _sweep(folder: Path, cache: Path, workers: int, jobs: int, overrides: list[str]) -> None:
    folder.mkdir()
    seeds = ",".join(map(str, range(jobs)))
    command = [sys.executable, "-c", "from see2act.commands.train import main; main()", "-m", f"seed={seeds}", *SMALL]
    command += [f"hydra.launcher.n_jobs={workers}", f"paths.cache={cache}", *overrides]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    done = len(list(folder.rglob("result.json")))
    if done != jobs:
        raise RuntimeError(f"{done} of {jobs} jobs of the sweep were finished: {(ended.stdout + ended.stderr)[-2000:]}")


if __name__ == "__main__":
    timed(__doc__, "Sweep", rows)
