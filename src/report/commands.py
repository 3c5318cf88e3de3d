"""What to type to run an arm again, or one that is missing."""

from __future__ import annotations

import shlex

from see2act.report.benches import Arm
from see2act.report.runs import Run


def command(arm: Arm) -> str:
    """What to type to run an arm again, with all of its seeds."""
    typed = {_without_seed(run) for run in arm.runs}
    if None in typed:
        return "unknown: .hydra/overrides.yaml is missing"
    if len(typed) > 1:  # they may differ in what leaves results as they are
        lines = [_line([*(_without_seed(run) or ()), f"seed={run.seed}"]) for run in arm.runs]
        return "\n".join(lines)
    return _line([*(typed.pop() or ()), f"seed={','.join(map(str, arm.seeds))}"])


def command_for(task: str, transfer: str, like: Arm) -> str:
    """What to type to run an arm that is missing, with the settings and the seeds of one that is there."""
    cell = {"task=": f"task={task}", "transfer=": f"transfer={transfer}"}
    typed = [o for o in _without_seed(like.runs[0]) or () if not o.startswith((*cell, "task."))]
    return _line([*typed, *cell.values(), f"seed={','.join(map(str, like.seeds))}"])


def _without_seed(run: Run) -> tuple[str, ...] | None:
    return None if run.overrides is None else tuple(o for o in run.overrides if not o.startswith(("seed=", "force=")))


def _line(arguments: list[str]) -> str:
    swept = any(a.startswith("experiment=") or (a.startswith("seed=") and "," in a) for a in arguments)
    return " ".join(["python train.py", *(["-m"] if swept else []), *map(shlex.quote, arguments)])
