"""What to type to run a group again, or one that is missing."""

from __future__ import annotations

import shlex

from see2act.analysis.groups import Group
from see2act.analysis.runs import Run

UNKNOWN = "unknown: .hydra/overrides.yaml is missing"


def command(group: Group) -> str:
    """What to type to run a group again, with all of its seeds."""
    typed = {_without_seed(run) for run in group.runs}
    if None in typed:
        return UNKNOWN
    if len(typed) > 1:  # they may differ in what leaves results as they are
        lines = [_line([*(_without_seed(run) or ()), f"seed={run.seed}"]) for run in group.runs]
        return "\n".join(lines)
    return _line([*(typed.pop() or ()), _seeds(group)])


def command_for(task: str, transfer: str, weights: str, like: Group) -> str:
    """What to type to run a group whose ``weights`` are missing, with the settings and the seeds of one that is there."""
    typed = _without_seed(like.runs[0])
    if typed is None:
        return UNKNOWN
    kept = [o for o in typed if not o.startswith(("task=", "transfer=", "task."))]
    return _line([*kept, f"task={task}", f"transfer={transfer}", _seeds(like), f"task.weights={weights}"])


def _seeds(group: Group) -> str:
    return f"seed={','.join(map(str, group.seeds))}"


def _without_seed(run: Run) -> tuple[str, ...] | None:
    return None if run.overrides is None else tuple(o for o in run.overrides if not o.startswith(("seed=", "force=")))


def _line(arguments: list[str]) -> str:
    swept = any(a.startswith("experiment=") or (a.startswith("seed=") and "," in a) for a in arguments)
    return " ".join(["python train.py", *(["-m"] if swept else []), *map(shlex.quote, arguments)])
