"""What a sweep costs beside its jobs, in time and memory: 200 tiny runs, made once and found finished twice, and a report."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from statistics import mean
from tempfile import TemporaryDirectory, TemporaryFile
from threading import Event, Thread
from time import perf_counter, time
from typing import Any

import numpy as np

from benchmarks.common import arguments, at_least_one, finish, parsed

TINY = (
    *("task=none", "transfer=none", "primitive=suction", "model.width=4", "precision=fp32", "logger=none"),
    *("collect.interactions=2", "collect.per_scene=2", "finetune.attempts=0", "figures.scenes=1"),
    *("evaluate.attempts={seen: 1, unseen: 1}", "evaluate.argmax=false"),
)
SECONDS, GROWTH, WARM = 1.0, 5.0, 20
"""Limits: seconds of bookkeeping per job, and MB per hundred jobs; jobs after which memory has to stay as it is."""


def rows(jobs: int, scratch: Path, overrides: list[str]) -> Iterator[dict[str, Any]]:
    """A row for each number."""
    sweep, seeds = scratch / "sweep", f"seed={','.join(map(str, range(jobs)))}"
    basic, joblib = ("hydra/launcher=basic",), ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    train = ["train", "-m", seeds, *TINY, f"hydra.sweep.dir={sweep}", f"paths.cache={scratch / 'cache'}", *overrides]
    first = Watched([*train, *basic], sweep)
    results = list(sweep.rglob("result.json"))
    if len(results) != jobs:
        raise RuntimeError(f"{len(results)} of {jobs} jobs were finished")
    own = [sum(json.loads(path.read_text())["seconds"].values()) for path in results]
    yield _row("a job's own work, by its result", mean(own), "s")
    yield _row("bookkeeping of a job that runs", first.seconds / jobs - mean(own), "s", SECONDS)
    yield _row("memory of the process that runs them all", first.memory, "MB")
    yield _row("its growth per 100 jobs", first.growth, "MB", GROWTH)
    for name, launcher in (("one process", basic), ("joblib, two processes", joblib)):
        again = Watched([*train, *launcher], sweep)
        yield _row(f"a job that is finished, {name}", again.seconds / jobs, "s")
        yield _row("its processor time, all of it bookkeeping", again.processor_seconds / jobs, "s", SECONDS)
        yield _row("its growth per 100 jobs", again.growth, "MB", GROWTH)
    report = Watched(["report", str(sweep)], sweep)
    yield _row(f"report of {jobs} runs", report.seconds, "s")
    yield _row("its memory", report.memory, "MB")


class Watched:
    """One command, run to its end and looked at every second.

    Args:
        words: After ``see2act``.
        sweep: Whose jobs are counted as they begin.

    Attributes:
        seconds: By the clock.
        processor_seconds: Of the command and of all processes that it has started and waited for.

    Raises:
        RuntimeError: It ended with another status than 0.
    """

    def __init__(self, words: list[str], sweep: Path):
        self._samples: list[tuple[int, float]] = []
        begin, start, used, ended = time(), perf_counter(), _processor_seconds(), Event()
        command = [sys.executable, "-c", "from see2act.commands.main import main; main()", *words]
        with TemporaryFile("w+") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
            watch = Thread(target=self._sample, args=(process.pid, sweep, begin, ended))
            watch.start()
            try:
                status = process.wait()
            finally:
                process.terminate()
                ended.set()
                watch.join()
            self.seconds, self.processor_seconds = perf_counter() - start, _processor_seconds() - used
            if status:
                output.seek(0)
                raise RuntimeError(output.read()[-2000:])

    def _sample(self, process: int, sweep: Path, begin: float, ended: Event) -> None:
        """Note how many jobs have begun, and the megabytes of the command and of all processes that it has started."""
        while not ended.wait(1):
            begun = sum(path.stat().st_mtime >= begin for path in sweep.rglob(".hydra/config.yaml"))
            self._samples.append((begun, sum(map(_megabytes, family(process)))))

    @property
    def memory(self) -> float:
        """Megabytes at most."""
        return max(memory for _, memory in self._samples)

    @property
    def growth(self) -> float:
        """Megabytes per 100 jobs."""
        return growth(self._samples)


def growth(samples: list[tuple[int, float]]) -> float:
    """Megabytes per 100 jobs from the ``WARM``-th on: between the medians of the first third of samples and the last.

    Args:
        samples: Jobs that have begun, and megabytes, in the order of time.
    """
    warm = [sample for sample in samples if sample[0] > WARM]
    third = len(warm) // 3
    (early, before), (late, after) = (np.median(part, axis=0) for part in (warm[:third], warm[-third:]))
    return float((after - before) / (late - early) * 100)


def family(process: int) -> set[int]:
    """A process, and all that it and they have started."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    found = {process}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def _processor_seconds() -> float:
    """Of all processes that this one has waited for, and of those that they have."""
    used = getrusage(RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _megabytes(process: int) -> float:
    """Of memory in use; none where it has ended."""
    with suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024
    return 0.0


def _row(name: str, value: float, unit: str, most: float | None = None) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "limit": most, "met": None if most is None else value <= most}


def main() -> None:
    """Measure, print a table, and end with status 1 if a limit is exceeded."""
    parser = arguments(__doc__, workers=False)
    parser.add_argument("--jobs", type=at_least_one, default=200, metavar="N", help="of the sweep (default 200)")
    args = parsed(parser)
    if args.jobs < 3 * WARM:
        parser.error(f"--jobs {args.jobs} is too small: memory is compared after the first {WARM}")
    table = []
    with TemporaryDirectory() as scratch:
        for row in rows(args.jobs, Path(scratch), args.overrides):
            table.append(row)
            print(row, file=sys.stderr, flush=True)
    finish("Many jobs", table, args.json)
    sys.exit(any(row["met"] is False for row in table))


if __name__ == "__main__":
    main()
