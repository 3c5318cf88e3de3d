"""Let things go wrong around a run, type the same command again, and compare with a run that was never disturbed.

A disk that is full, a folder that is read-only, two processes on one run, a clock that jumps, files of the cache that were
cut short, and a user without rights, home, locale or terminal. On Linux, as root, which mounts small disks, and
with a C compiler, which the clock needs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from benchmarks.common import finish
from benchmarks.disturbed import ROOT, Command, damaged_files, differences, kept, outcome, train

RUN = ("task=edge", "transfer=full", "primitive=suction")
ROOMS = (0.02, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
"""Sizes of the disks, as shares of what the run and its cache take."""
SHARES = (0.0, 0.5, 0.99)
"""What is left of a file that is cut short."""
CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

static long offset(void) {
    long seconds = 0;
    FILE *file = fopen(getenv("CLOCK_OFFSET"), "r");
    if (file) { if (fscanf(file, "%ld", &seconds) != 1) seconds = 0; fclose(file); }
    return seconds;
}
int clock_gettime(clockid_t clock, struct timespec *t) {
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int status = real(clock, t);
    if (clock == CLOCK_REALTIME) t->tv_sec += offset();
    return status;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec; t->tv_usec = now.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *t) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t) *t = now.tv_sec;
    return now.tv_sec;
}
"""
"""A library that moves the time of day by the seconds in a file. Clocks that only go forward stay as they are."""
NOBODY = 65534
Faults = list[str]


class Bench:
    """A place for the cases, and the run that was never disturbed."""

    def __init__(self, scratch: Path):
        self.scratch = scratch
        self._count = 0
        whole = self.folder()
        self.cache = whole / "cache"
        self.whole = whole / "run"
        if Command(train(self.whole, self.cache, *RUN), whole, whole / "printed.txt").wait():
            sys.exit(f"the undisturbed run fails: {(whole / 'printed.txt').read_text()[-2000:]}")
        self.undisturbed = outcome(self.whole)

    def folder(self) -> Path:
        """A new one."""
        self._count += 1
        made = self.scratch / f"case{self._count}"
        made.mkdir()
        return made

    def type(self, run: Path, cache: Path, **how: Any) -> Command:
        """Type the command."""
        cwd = self.folder()
        return Command(train(run, cache, *RUN), cwd, cwd / "printed.txt", **how)

    def ends_well(self, command: Command, run: Path, cache: Path | None = None) -> Faults:
        """What is wrong with a command that should have made the run."""
        if status := command.wait():
            return [f"ends with status {status}: {command.printed[-300:]}"]
        faults = [f"{name} differs" for name in differences(run, self.undisturbed)]
        faults += [f"cache: {fault}" for fault in damaged_files(cache or self.cache)]
        return faults + (["processes are left"] if command.orphans() else [])

    def refused(self, command: Command, *words: str) -> Faults:
        """What is wrong with a command that should have ended with one line."""
        status, printed = command.wait(), command.printed
        faults = [] if status else ["its exit status is 0"]
        faults += ["a traceback is printed"] if "Traceback" in printed else []
        faults += [f"it does not say {word!r}: {printed[-300:]}" for word in words if word not in printed]
        return faults + (["processes are left"] if command.orphans() else [])


def full_disk(bench: Bench) -> Iterator[Faults]:
    """The disk fills up at some moment of a run; room is made, and the same command goes on."""
    taken = sum(path.stat().st_blocks * 512 for part in (bench.whole, bench.cache) for path in part.rglob("*"))
    for room in ROOMS:
        with _disk(bench.folder(), str(int(room * taken))) as disk:
            run, cache = disk / "run", disk / "cache"
            faults = bench.refused(bench.type(run, cache), "No space left on device", "free some space")
            _mount("-o", "remount,size=200m", str(disk))
            yield faults + bench.ends_well(bench.type(run, cache), run, cache)


def read_only(bench: Bench) -> Iterator[Faults]:
    """The run's folder, or the cache, cannot be written: nothing begins."""
    with _disk(bench.folder(), "20m") as disk:
        _mount("-o", "remount,ro", str(disk))
        elsewhere = bench.folder()
        yield bench.refused(bench.type(disk / "run", bench.cache), "cannot be written")
        yield bench.refused(bench.type(elsewhere / "run", disk / "cache"), "cannot be written") + [
            f"{path.name} was made" for path in elsewhere.iterdir()
        ]


def two_processes(bench: Bench) -> Iterator[Faults]:
    """The same command twice, at once and one a little later: one makes the run, the other one is refused."""
    for later in (0.0, 3.0, 6.0):
        run = bench.folder() / "run"
        first = bench.type(run, bench.cache)
        time.sleep(later)
        second = bench.type(run, bench.cache)
        statuses = [first.wait(), second.wait()]
        winner, loser = (first, second) if statuses[0] == 0 else (second, first)
        faults = bench.ends_well(winner, run)
        if "this run is finished already" not in loser.printed:
            faults += bench.refused(loser, "another process is at work in", "wait for it to end")
        yield faults


def jumping_clock(bench: Bench) -> Iterator[Faults]:
    """The clock jumps by a day, back or forth, several times in a run."""
    library = bench.folder() / "clock.so"
    compiler = ["cc", "-shared", "-fPIC", "-x", "c", "-o", str(library), "-", "-ldl"]
    subprocess.run(compiler, input=CLOCK, text=True, check=True)
    for jumps in ((-1, 0), (1, -1, 400)):
        folder = bench.folder()
        run, offset = folder / "run", folder / "offset"
        offset.write_text("0")
        command = bench.type(run, folder / "cache", environment={"LD_PRELOAD": str(library), "CLOCK_OFFSET": str(offset)})
        turn = 0
        while command.process.poll() is None:
            time.sleep(4)
            offset.write_text(str(86400 * jumps[turn % len(jumps)]))
            turn += 1
        yield bench.ends_well(command, run, folder / "cache") + ([] if turn > 2 else ["the clock did not jump"])


def cut_files(bench: Bench) -> Iterator[Faults]:
    """Each file of the cache is cut short: it is made again."""
    files = [path.relative_to(bench.cache) for path in kept(bench.cache)]
    for name in files:
        for share in SHARES:
            folder = bench.folder()
            cache = folder / "cache"
            shutil.copytree(bench.cache, cache)
            content = (cache / name).read_bytes()
            (cache / name).write_bytes(content[: int(share * len(content))])
            command = bench.type(folder / "run", cache)
            faults = bench.ends_well(command, folder / "run", cache)
            said = f"{name.name} is damaged, and is made again" in command.printed
            # What nobody needs is neither read nor mended: the layout of a scene whose observations are there.
            if (cache / name).read_bytes() == content[: int(share * len(content))]:
                faults = [fault for fault in faults if name.name not in fault]
            elif not said:
                faults.append("nothing is said")
            yield [f"{name}, {share:g}: {fault}" for fault in faults]


def bare_user(bench: Bench) -> Iterator[Faults]:
    """A user without rights, home, locale and terminal, in a folder with spaces and umlauts; output into ``head``."""
    place = bench.folder() / "Käse & Brot"
    shutil.copytree(ROOT, place, symlinks=True, ignore=shutil.ignore_patterns(".venv", ".git", "outputs", "multirun", "build"))
    for folder in (bench.scratch, place.parent, place):
        folder.chmod(0o777)
    bare = ["env", "-i", f"PATH={os.environ['PATH']}", "LC_ALL=C", "PYTHONDONTWRITEBYTECODE=1", "OMP_NUM_THREADS=1"]
    user = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", *bare]
    if subprocess.run([*user, sys.executable, "-c", ""], check=False).returncode:
        sys.exit(f"{sys.executable} is for its owner alone: chmod o+x the folders above the real one")
    for shell in ('"$@"', '"$@" | head -n 2'):
        run, cache = place / f"Läufe {len(shell)}", place / f"Zwischenspeicher {len(shell)}"
        arguments = [str(place / "train.py"), *train(run, cache, *RUN)[1:]]
        arguments = [_quoted(text) if "=" in text else text for text in arguments]
        done = subprocess.run(
            [*user, "sh", "-c", f"cd '{place}' && {shell}", "sh", sys.executable, *arguments],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=900, check=False,
        )  # fmt: skip
        faults = [] if done.returncode == 0 else [f"ends with status {done.returncode}: {done.stderr[-500:]}"]
        faults += [f"it prints to the error stream: {done.stderr[-500:]}"] if "Traceback" in done.stderr else []
        yield faults + [f"{name} differs" for name in differences(run, bench.undisturbed)]


def _quoted(override: str) -> str:
    """As Hydra wants a value with spaces and other signs."""
    key, value = override.split("=", 1)
    return f"{key}='{value}'" if "/" in value else override


CASES: dict[str, Callable[[Bench], Iterator[Faults]]] = {
    "full disk": full_disk,
    "read-only folder": read_only,
    "two processes on one run": two_processes,
    "clock that jumps": jumping_clock,
    "cache file cut short": cut_files,
    "no rights, home, locale, terminal": bare_user,
}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    parser.add_argument("--only", choices=CASES, help="one kind of fault")
    args = parser.parse_args()
    scratch = Path(mkdtemp(prefix="see2act-faults-"))
    rows: list[dict[str, Any]] = []
    try:
        bench = Bench(scratch)
        for name, case in CASES.items():
            if args.only not in (None, name):
                continue
            results = []
            for faults in case(bench):
                results.append(faults)
                for fault in faults:
                    print(f"{name}: {fault}", flush=True)
            rows.append({"fault": name, "cases": len(results), "as it should be": sum(not faults for faults in results)})
            print(rows[-1], flush=True)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    finish("faults", rows, args.json)
    sys.exit(0 if all(row["cases"] == row["as it should be"] for row in rows) else 1)


@contextmanager
def _disk(folder: Path, size: str) -> Iterator[Path]:
    """A small disk in memory."""
    _mount("-t", "tmpfs", "-o", f"size={size}", "see2act", str(folder))
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _mount(*arguments: str) -> None:
    subprocess.run(["mount", *arguments], check=True)


if __name__ == "__main__":
    main()
