"""Results and attempts with numbers that a test does not care about, by the schema that runs write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

from see2act.experiment.attempts import AttemptRow
from see2act.experiment.results import BLOCK, Block, Evaluation, RunCounts, RunResult, SplitCounts, StepEvaluation

Counts = Sequence[tuple[int, int]]
"""Successes and attempts of each test run."""
CHOICES = {
    **{"task": "normal", "transfer": "full", "primitive": "suction", "model": "fcn7", "objects": "diverse"},
    **{"workspace": "bin", "camera": "side", "policy": "suppress", "labels": "truth", "precision": "fp32", "motion": "fast"},
}
VERSIONS = {"python": "3.11.7", "see2act": "0.1.0", "numpy": "2.4.6"}


def split_counts(counts: Counts) -> SplitCounts:
    runs = [RunCounts(scene_seed=i, successes=s, attempts=n) for i, (s, n) in enumerate(counts)]
    return SplitCounts.of(runs, truth_successes=sum(s for s, _ in counts))


def evaluation(seen: Counts, unseen: Counts) -> Evaluation:
    return Evaluation(seen=split_counts(seen), unseen=split_counts(unseen))


def finished_run(
    seed: int = 0,
    config_hash: str = "aaaaaaaaaaaa",
    seen: Counts = ((8, 10), (9, 10)),
    unseen: Counts = ((7, 10), (10, 10)),
    zero: Counts = ((3, 10), (4, 10)),
    learned: Sequence[int] = (0, 1) * 20,
    versions: dict[str, str] = VERSIONS,
    between: Mapping[int, Counts] | None = None,
    **choices: Any,
) -> RunResult:
    """A run that learned with the outcomes ``learned``, and was tested before and after; never fine-tuned if it is empty.

    ``between`` has tests of unseen objects on the way, by step.
    """
    runs = {len(seen), len(unseen), len(zero)}
    zero = zero if len(runs) == 1 else [(0, 1)] * len(unseen)
    seen = seen if len(runs) == 1 else [(0, 1)] * len(unseen)
    before, after = evaluation(zero, zero), evaluation(seen, unseen)
    if not learned:
        before = after = before.model_copy(update={"repeated": True})
    blocks = [learned[i : i + BLOCK] for i in range(0, len(learned), BLOCK)]
    ends = accumulate(map(len, blocks))
    on_the_way = {step: evaluation(seen, counts) for step, counts in (between or {}).items()}
    steps = {0: before, **on_the_way, len(learned): after}
    return RunResult(
        choices=CHOICES | choices | {"seed": seed},
        config_hash=config_hash,
        versions=versions,
        seconds={"finetune": 90.0, "figures": 30.0},
        zero_shot=before,
        eval=after,
        eval_argmax=evaluation(zero, zero),
        evals=tuple(StepEvaluation(step=step, **dict(point)) for step, point in steps.items()),
        curve=tuple(Block(step=end, successes=sum(b), attempts=len(b)) for end, b in zip(ends, blocks, strict=True)),
    )


def attempt_row(**values: Any) -> AttemptRow:
    """A successful attempt while learning, but for what is given."""
    words = {"phase": "finetune", "split": "seen", "policy": "suppress", "primitive": "suction", "cause": "ok"}
    numbers = dict.fromkeys(("run", "step", "episode", "scene_seed", "row", "col", "lost"), 0)
    numbers |= dict.fromkeys(("angle", "x", "y", "z", "score", "entropy"), 0.0)
    times = dict.fromkeys(("t_observe", "t_decide", "t_act", "t_learn", "t_total"), 0.0)
    flags = {"explore": False, "success": True, "truth": True, "robot_seconds": 6.0}
    return AttemptRow(**(words | numbers | times | flags | values))
