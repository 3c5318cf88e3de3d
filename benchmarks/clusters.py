"""What the checks of clusters share: daemons that end with them, sweeps of the smoke experiment, and a list of promises."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
Environment = dict[str, str]


def options(description: str | None) -> argparse.ArgumentParser:
    """A parser with the options that all checks have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="a new folder for all files, which is kept (default: none is)")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="for the sweep, as for train.py; task=none is short")
    return parser


class Promises:
    """What was promised and whether it was kept, told line by line."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self.broken = 0

    def tell(self, text: str) -> None:
        """Print a line with the seconds since the start."""
        print(f"[{time.monotonic() - self._start:4.0f} s] {text}", flush=True)

    def check(self, kept: bool, promise: str, seen: object = "") -> None:
        """Print one promise, and what was seen."""
        self.broken += not kept
        self.tell(f"{'ok    ' if kept else 'BROKEN'} {promise}{f': {seen}' if seen else ''}")

    def end(self) -> None:
        """End the program, with status 1 if a promise was broken."""
        self.tell(f"{self.broken} promises were broken" if self.broken else "all promises were kept")
        sys.exit(bool(self.broken))


def run_check(check: Callable[[Path, list[str], Promises], None], args: argparse.Namespace) -> None:
    """Run a check in a new folder and end the program: with status 1 if a promise was broken, or a process is left."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # daemons end whatever ends this program
    promises = Promises()
    with ExitStack() as scratch:
        folder = (args.keep or Path(scratch.enter_context(TemporaryDirectory()))).absolute()
        folder.mkdir(exist_ok=args.keep is None)
        check(folder, args.overrides, promises)
        left = left_over(str(folder))
        promises.check(not left, "no process is left", left)
    promises.end()


class Sweep:
    """One sweep of the smoke experiment, whose command may be given several times.

    Args:
        folder: Of the sweep; the cache is beside it.
        environment: Of its processes.
        overrides: For ``train.py -m experiment=smoke``.
    """

    def __init__(self, folder: Path, environment: Environment, *overrides: str):
        self.folder, self._environment, self._times = folder, environment, 0
        own = (f"hydra.sweep.dir={folder}", f"paths.cache={folder.parent / 'cache'}", "precision=fp32", "logger=none")
        self._command = [sys.executable, str(ROOT / "train.py"), "-m", "experiment=smoke", *own, *overrides]

    @contextmanager
    def started(self) -> Iterator[subprocess.Popen[str]]:
        """Its process, which writes to ``output``. It is interrupted if the block is left before it has ended."""
        self._times += 1
        with (
            self.output.open("w") as file,
            subprocess.Popen(
                self._command, env=self._environment, stdout=file, stderr=file, text=True, start_new_session=True
            ) as process,
        ):
            try:
                yield process
            finally:
                end_group(process)

    def run(self) -> int:
        """Its exit status, when it has ended."""
        with self.started() as process:
            return process.wait()

    @property
    def output(self) -> Path:
        """What the last command has printed."""
        return self.folder.with_name(f"{self.folder.name}.{self._times}.log")

    def results(self) -> dict[Path, int]:
        """Folders of finished runs, with the time of their results in ns."""
        return {path.parent: path.stat().st_mtime_ns for path in self.folder.rglob("result.json")}

    def at_work(self) -> list[Path]:
        """Folders of runs that have been begun and have no result."""
        begun = {path.parent for path in self.folder.rglob("run.json")}
        return sorted(begun - set(self.results()))

    def report(self) -> Path:
        """The page that report.py makes of it."""
        command = [sys.executable, str(ROOT / "report.py"), str(self.folder)]
        subprocess.run(command, env=self._environment, check=True, stdout=subprocess.DEVNULL)
        return self.folder / "report.html"


def wait_until(reached: Callable[[], bool], seconds: float, otherwise: str) -> None:
    """Wait for something that other processes bring about.

    Raises:
        TimeoutError: It took longer.
    """
    end = time.monotonic() + seconds
    while not reached():
        if time.monotonic() > end:
            raise TimeoutError(otherwise)
        time.sleep(0.2)


@contextmanager
def daemon(command: list[str], log: Path, environment: Environment, patience: float = 20) -> Iterator[subprocess.Popen[bytes]]:
    """A program that runs until the end of the block, with all that it has started; it is killed after ``patience`` seconds."""
    with (
        log.open("ab") as file,
        subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
        ) as process,
    ):
        try:
            yield process
        finally:
            end_group(process, patience)


def end_group(process: subprocess.Popen, patience: float = 20) -> None:
    """End a process that leads a session: by SIGTERM, after ``patience`` seconds by SIGKILL, with what is left of its group."""
    if process.poll() is None:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def left_over(word: str) -> list[str]:
    """Processes, other than this one, whose environment has a word in it: number and command."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            command = (folder / "cmdline").read_bytes()
            if word.encode() in (folder / "environ").read_bytes() and int(folder.name) != os.getpid():
                found.append(f"{folder.name} {command.replace(bytes(1), b' ').decode(errors='replace')[:80]}")
    return found


def free_ports(count: int) -> list[int]:
    """Ports of this machine that nobody listens at."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports
