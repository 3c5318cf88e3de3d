"""Kill runs, sweeps and reports at random moments, type the same commands again, and compare with what was never disturbed.

A run is killed once in each of its stages; the last command ends undisturbed. Then its attempts, result and weights and what
it left in the cache must be those of an undisturbed run, and no process may be left. A sweep with two workers is killed as a
whole, or a worker of it. The commands are real, at tiny numbers, with wandb as the logger. On Linux only.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp

from benchmarks.common import at_least_one, finish
from benchmarks.disturbed import ROOT, Command, content, damaged_files, differences, outcome, sweep, train
from see2act.experiment.results import read_result

STAGES = ("collect", "pretrain", "transfer", "finetune", "evaluate")
SIGNALS = {"KILL": signal.SIGKILL, "TERM": signal.SIGTERM}
SHORTEST = 0.3
"""Seconds within which a stage is killed that takes less."""
RUN = ("task=edge", "transfer=full", "primitive=suction")
SWEEP = ("logger=none", "task=none,edge", "transfer=none,full", "primitive=suction")
REPORTED = ("table.csv", "table.md", "progress.csv")


@dataclass
class Campaign:
    """What has happened so far."""

    scratch: Path
    rng: random.Random
    signal: signal.Signals
    kills: Counter[str] = field(default_factory=Counter)
    trials: int = 0
    wrong: list[str] = field(default_factory=list)

    def fault(self, *faults: str) -> None:
        """Something that must not be."""
        self.wrong += faults
        for line in faults:
            print(f"  {line}", flush=True)

    def start(self, arguments: Sequence[str], cwd: Path) -> Command:
        """Type a command."""
        return Command(arguments, cwd, cwd / "printed.txt")

    def kill(self, command: Command, where: str, victim: int | None = None) -> None:
        """End a command, or one worker of it, and see that nothing of it is left."""
        os.kill(victim or command.process.pid, self.signal)
        status = command.wait()
        self.kills[where] += 1
        if status == 0 and not victim and "result.json" not in command.printed[-1000:]:  # it had not finished by then
            self.fault(f"{where}: killed, and the exit status is 0")
        if left := command.orphans():
            self.fault(f"{where}: {len(left)} processes are left")
            for pid in left:
                os.kill(pid, signal.SIGKILL)
        if (victim or self.signal != signal.SIGKILL) and "Traceback" in command.printed:
            self.fault(f"{where}: a traceback was printed: {command.printed[-1500:]}")

    def finish(self, arguments: Sequence[str], cwd: Path, what: str) -> Command:
        """Type the same command again and let it end."""
        command = self.start(arguments, cwd)
        if status := command.wait():
            self.fault(f"{what}: typed again, it ends with status {status}: {command.printed[-300:]}")
        if left := command.orphans():
            self.fault(f"{what}: {len(left)} processes are left")
        self.trials += 1
        return command


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows here")
    parser.add_argument("--kills", type=at_least_one, default=100, metavar="N", help="at least so many (default 100)")
    parser.add_argument("--signal", choices=SIGNALS, default="KILL")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the moments")
    args = parser.parse_args()
    scratch = Path(mkdtemp(prefix="see2act-kills-"))
    campaign = Campaign(scratch, random.Random(args.seed), SIGNALS[args.signal])
    try:
        _all(campaign, args.kills)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if campaign.kills:
        rows = [{"killed in": where, "times": times} for where, times in sorted(campaign.kills.items())]
        finish(f"SIG{args.signal}", rows, args.json)
    print(f"{campaign.kills.total()} kills, {campaign.trials} commands typed again to their end, {len(campaign.wrong)} faults")
    sys.exit(1 if campaign.wrong else 0)


def _all(campaign: Campaign, kills: int) -> None:
    whole = campaign.scratch / "whole"
    whole.mkdir()
    for arguments in (train(whole / "run", whole / "cache", *RUN), sweep(whole / "sweep", whole / "cache", *SWEEP)):
        campaign.finish(arguments, whole, "undisturbed")
    campaign.finish(_report(whole), whole, "undisturbed report")
    if campaign.wrong:
        return
    print(f"undisturbed: {time.strftime('%H:%M:%S')}", flush=True)
    parts: tuple[Callable[[Campaign, Path, int], None], ...] = (_sweep, _run, _run, _reports, _run)
    trial = 0
    while campaign.kills.total() < kills:
        parts[trial % len(parts)](campaign, whole, trial)
        trial += 1
        print(f"{time.strftime('%H:%M:%S')} {campaign.kills.total()} kills, {len(campaign.wrong)} faults", flush=True)


def _run(campaign: Campaign, whole: Path, trial: int) -> None:
    folder = campaign.scratch / f"run{trial}"
    folder.mkdir()
    arguments = train(folder / "run", folder / "cache", *RUN)
    seconds = read_result(whole / "run" / "result.json").seconds
    for number, stage in enumerate(STAGES, start=1):
        command = campaign.start(arguments, folder)
        if not _reaches(command, f"stage {number} of {len(STAGES)}"):
            break  # it was killed so late in the stage before that nothing is left to do
        time.sleep(campaign.rng.uniform(0, max(seconds[stage], SHORTEST)))
        if command.process.poll() is not None:
            break
        campaign.kill(command, f"a run, {_stage(command)}")
    command = campaign.start(arguments, folder)
    time.sleep(campaign.rng.uniform(0, 5.0))  # imports, and looking at what is there
    if command.process.poll() is None:
        campaign.kill(command, f"a run, {_stage(command)}")
    campaign.finish(arguments, folder, f"run {trial}")
    _compare(campaign, f"run {trial}", {folder / "run": whole / "run"}, folder / "cache", whole / "cache")
    shutil.rmtree(folder)


def _sweep(campaign: Campaign, whole: Path, trial: int) -> None:
    folder = campaign.scratch / f"sweep{trial}"
    folder.mkdir()
    arguments = sweep(folder / "sweep", folder / "cache", *SWEEP)
    runs = [path.parent.relative_to(whole / "sweep") for path in (whole / "sweep").rglob("result.json")]
    longest = max(sum(read_result(path).seconds.values()) for path in (whole / "sweep").rglob("result.json"))
    for one_worker in (False, True, False):
        command = campaign.start(arguments, folder)
        _reaches(command, "stage 1 of")
        time.sleep(campaign.rng.uniform(0, longest))
        if command.process.poll() is not None:
            break
        victim = next(iter(_workers(command)), None) if one_worker else None
        campaign.kill(command, "a sweep, a worker" if victim else "a sweep", victim)
        results = len([*(folder / "sweep").rglob("result.json")])
        if victim and command.wait() == 0 and results < len(runs):
            campaign.fault(f"a sweep, a worker: killed, the exit status is 0, and {results} of {len(runs)} runs are finished")
    campaign.finish(arguments, folder, f"sweep {trial}")
    pairs = {folder / "sweep" / run: whole / "sweep" / run for run in runs}
    _compare(campaign, f"sweep {trial}", pairs, folder / "cache", whole / "cache")
    shutil.rmtree(folder)


def _reports(campaign: Campaign, whole: Path, trial: int) -> None:
    folder = campaign.scratch / f"report{trial}"
    shutil.copytree(whole / "sweep", folder / "sweep")
    for path in REPORTED:
        (folder / "sweep" / path).unlink()
    for _ in range(2):
        command = campaign.start(_report(folder), folder)
        time.sleep(campaign.rng.uniform(0, 8.0))
        if command.process.poll() is None:
            campaign.kill(command, "a report")
    campaign.finish(_report(folder), folder, f"report {trial}")
    campaign.fault(
        *[
            f"report {trial}: {name} differs"
            for name in REPORTED
            if (folder / "sweep" / name).read_bytes() != (whole / "sweep" / name).read_bytes()
        ]
    )
    campaign.fault(*[f"report {trial}: {path.name} is left" for path in folder.rglob(".*.partial")])
    shutil.rmtree(folder)


def _report(folder: Path) -> list[str]:
    return [str(ROOT / "report.py"), str(folder / "sweep")]


def _compare(campaign: Campaign, what: str, runs: dict[Path, Path], cache: Path, whole_cache: Path) -> None:
    for run, whole in runs.items():
        campaign.fault(*[f"{what}: {run.parent.name}: {name}" for name in differences(run, outcome(whole))])
        campaign.fault(*[f"{what}: {path.name} is left" for path in run.rglob(".*.partial")])
    campaign.fault(*[f"{what}: cache: {fault}" for fault in damaged_files(cache)])
    undisturbed = content(whole_cache)
    changed = [name for name, digest in content(cache).items() if undisturbed[name] != digest]
    campaign.fault(*[f"{what}: cache: {name} differs" for name in changed])


def _reaches(command: Command, words: str) -> bool:
    """Whether it prints the words before it ends."""
    while words not in command.printed:
        if command.process.poll() is not None:
            return words in command.printed
        time.sleep(0.02)
    return True


def _stage(command: Command) -> str:
    reached = [name for number, name in enumerate(STAGES, start=1) if f"stage {number} of" in command.printed]
    return reached[-1] if reached else "start"


def _workers(command: Command) -> list[int]:
    """Processes of joblib's that run jobs."""
    return [pid for pid in command.processes() if b"LokyProcess" in Path(f"/proc/{pid}/cmdline").read_bytes()]


if __name__ == "__main__":
    main()
