"""The paper's evaluation protocol (section IV)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from tqdm import tqdm

from see2act.attempt import Affordances, Attempt, attempt
from see2act.experiment.results import SPLITS, Evaluation, RunCounts, SplitCounts
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Split
from see2act.seeding import seed_for


@dataclass(frozen=True)
class EvaluationProtocol:
    """How success is measured.

    Args:
        runs: Test runs per split.
        attempts: Most attempts of a test run, by split (paper: 25 seen, 15 unseen).
        scenes: ``evaluate``, or ``develop`` for other scenes: those to choose settings by.
    """

    runs: int
    attempts: Mapping[str, int]
    scenes: str = "evaluate"


class EvaluationRun(NamedTuple):
    """A test run of the protocol: one scene."""

    split: Split
    run: int
    scene_seed: int


class Judged(Protocol):
    """What counts of an attempt: an outcome, or the row of a log."""

    @property
    def success(self) -> bool: ...
    @property
    def truth(self) -> bool | None: ...
    @property
    def lost(self) -> int: ...


def scene_seed(split: Split, run: int, scenes: str = "evaluate") -> int:
    """The canonical scene of a test run: the same for every model and seed, and never used in training."""
    return seed_for(f"scene/{scenes}/{split}", run)


def evaluate(
    robot: Robot,
    affordances: Affordances,
    policy: Policy,
    protocol: EvaluationProtocol,
    record: Callable[[Attempt, EvaluationRun], None],
    title: str = "evaluate",
    known: Mapping[tuple[Split, int], Sequence[Judged]] | None = None,
    going_on: Policy | None = None,
) -> Evaluation:
    """Success rates on seen and unseen objects.

    A test run ends when the bin is truly empty or its attempts are spent.

    Args:
        robot: Reset to each canonical scene.
        affordances: The model, not changed.
        policy: The rule for picks; each test run starts with an empty memory.
        protocol: How many test runs and attempts.
        record: Called with each attempt.
        title: Of the progress bar.
        known: By split and run, attempts of test runs that are not made again.
        going_on: The policy, with its memory, of the last one of these, where that was interrupted: it goes on.
    """
    known = known or {}
    most = protocol.runs * sum(protocol.attempts[split] for split in SPLITS)
    counts: dict[str, SplitCounts] = {}
    with tqdm(total=most, desc=title, disable=None) as bar:
        for split in SPLITS:
            runs, truths = [], list[bool | None]()
            for run in range(protocol.runs):
                test = EvaluationRun(split, run, scene_seed(split, run, protocol.scenes))
                judged: list[Judged] = list(known.get((split, run), ()))
                interrupted = going_on if known and (split, run) == list(known)[-1] else None
                if interrupted or not judged:
                    rule, most_attempts = interrupted or policy.fresh(), protocol.attempts[split]
                    for done in one_test_run(robot, affordances, rule, test.scene_seed, split, most_attempts, len(judged)):
                        record(done, test)
                        judged.append(done.outcome)
                        bar.update()
                truths += [each.truth for each in judged]
                runs.append(_counted(test.scene_seed, judged))
            known_truths = [truth for truth in truths if truth is not None]
            counts[split] = SplitCounts.of(runs, sum(known_truths) if len(known_truths) == len(truths) else None)
    return Evaluation(seen=counts["seen"], unseen=counts["unseen"])


def _counted(seed: int, judged: Sequence[Judged]) -> RunCounts:
    successes, lost = sum(each.success for each in judged), sum(each.lost for each in judged)
    return RunCounts(scene_seed=seed, successes=successes, attempts=len(judged), lost=lost)


def one_test_run(
    robot: Robot, affordances: Affordances, policy: Policy, seed: int, split: Split, attempts: int, made: int = 0
) -> Iterator[Attempt]:
    """One test run on the scene of ``seed``: attempts until the bin is truly empty or ``attempts`` are spent.

    With ``made`` attempts of an interrupted run, which the policy remembers, it goes on in that scene; or, if the bin was
    changed meanwhile, in a new one.
    """
    if made >= attempts:
        return
    if not (made and robot.resume(seed, made)):
        robot.reset(seed, split)
        policy.forget()
    for _ in range(attempts - made):
        if robot.bin_empty():
            return
        yield attempt(robot, affordances, policy)
