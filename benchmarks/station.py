"""Does the code for a real robot learn as the simulation does? A run with `robot=ur5_real` on stand-ins beside a simulated one.

`python -m benchmarks.station --attempts 30 --kill 3` takes about 20 minutes. The client of the arm, the tool, the camera, the
prompts and the run are those of a real robot; the controller, the camera's program and the person are stand-ins with the
simulated scene behind them. With `--kill` the run is killed by SIGKILL in the middle of a motion and typed again, so often.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.stand_in.cell import StandInCell
from benchmarks.stand_in.person import Person
from see2act.experiment import attempts

HOST = "127.42.0.1"
PROMPT = re.compile(r">> (.+)\n>> $", re.DOTALL)
REAL = ("robot=ur5_real", "camera=files", "camera.frames=1")
SHORT = ("collect.interactions=8", "collect.per_scene=4", "evaluate.runs=1", "figures.scenes=1", "logger=none", "threads=1")
TEST = ("evaluate.attempts.seen=5", "evaluate.attempts.unseen=5")


class Session:
    """Types a command, and hands its questions to the person at the station.

    Args:
        command: Of the run.
        cell: The stand-in for the station.
    """

    def __init__(self, command: Sequence[str], cell: StandInCell):
        self._command, self._cell = command, cell
        self.person = Person(cell)

    def run(self, kill_after: float | None = None) -> int | None:
        """Type the command and answer until it ends.

        Args:
            kill_after: Seconds after which it is killed, at the first motion that is under way; None lets it end.

        Returns:
            Its exit status; None if it was killed.
        """
        pipe = subprocess.PIPE
        process = subprocess.Popen(self._command, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, bufsize=0)
        assert process.stdin is not None
        assert process.stdout is not None
        started, said = time.monotonic(), ""
        while process.poll() is None:
            if select.select([process.stdout], [], [], 0.05)[0]:
                piece = os.read(process.stdout.fileno(), 65536).decode(errors="replace")
                sys.stdout.write(piece)
                sys.stdout.flush()
                said = (said + piece)[-4000:]
            if request := PROMPT.search(said):
                said = ""
                process.stdin.write(f"{self.person.ask(request[1])}\n".encode())
            if kill_after is not None and time.monotonic() - started > kill_after and self._cell.moving():
                process.send_signal(signal.SIGKILL)
                process.wait()
                return None
        return process.returncode


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attempts", type=int, default=30)
    parser.add_argument("--kill", type=int, default=0, metavar="N", help="kill the run N times in the middle of a motion")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="seconds between kills")
    parser.add_argument("--out", type=Path, default=Path("build/station"), metavar="DIR")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration of both runs")
    args = parser.parse_intermixed_args()
    if args.out.exists():
        sys.exit(f"{args.out} exists: give another --out")
    given = [f"finetune.attempts={args.attempts}", f"evaluate.at=[{args.attempts}]", *SHORT, *TEST, *args.overrides]
    scene = [word for word in args.overrides if word.split("=")[0] in ("primitive", "objects", "workspace")]
    cell = StandInCell(HOST, args.out, ["robot.bin.floor=plain", *scene])
    try:
        place = [f"robot.station={args.out}/station.yaml", f"camera.folder={args.out}/camera"]
        place += [f"collect.folder={args.out}/observations"]
        session = Session([sys.executable, "train.py", *REAL, *place, *given, f"hydra.run.dir={args.out}/real"], cell)
        kills = 0
        while (status := session.run(args.every if kills < args.kill else None)) is None:
            kills += 1
            print(f"\n[kill {kills} of {args.kill}]\n", flush=True)
    finally:
        cell.close()
    if status:
        sys.exit(status)
    simulated = [sys.executable, "train.py", *given, "labels=vision", f"hydra.run.dir={args.out}/simulated"]
    subprocess.run(simulated, check=True)
    _report(args.out, kills)


def _report(out: Path, kills: int) -> None:
    print(f"\nThe run at the station was killed {kills} times.\n\n| | learning | evaluated, seen | unseen |\n|---|---|---|---|")
    for name in ("real", "simulated"):
        rows = [row for row in attempts.read(out / name / "attempts.csv") if row.phase == "finetune"]
        result = json.loads((out / name / "result.json").read_text())
        tested = " | ".join(f"{result['eval'][s]['successes']}/{result['eval'][s]['attempts']}" for s in ("seen", "unseen"))
        print(f"| {name} | {sum(row.success for row in rows)}/{len(rows)} | {tested} |")
    steps = [row.step for row in attempts.read(out / "real" / "attempts.csv") if row.phase == "finetune"]
    print(f"\nTraining attempts 1 to {steps[-1]}, each once: {'yes' if steps == list(range(1, len(steps) + 1)) else 'NO'}")


if __name__ == "__main__":
    main()
