"""The paper's evaluation protocol (section IV)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from see2act.attempt import Affordances, Attempt, attempt
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Split
from see2act.seeding import seed_for
from tqdm import tqdm

SPLITS: tuple[Split, ...] = ("seen", "unseen")


@dataclass(frozen=True)
class Protocol:
    """How success is measured.

    Args:
        runs: Test runs a split.
        attempts: Most attempts of a test run, by split (paper: 25 seen, 15 unseen).
        scenes: ``evaluate``, or ``develop`` for other scenes: those to choose settings by.
    """

    runs: int
    attempts: dict[str, int]
    scenes: str = "evaluate"


def scene_seed(split: Split, run: int, scenes: str = "evaluate") -> int:
    """The canonical scene of a test run: the same for every arm and seed, and never used in training."""
    return seed_for(f"scene/{scenes}/{split}", run)


class Counts(NamedTuple):
    """What counts of an attempt."""

    success: bool
    truth: bool
    lost: int


TestRun = tuple[Split, int]
"""Of which split, and which of its test runs."""


def evaluate(
    robot: Robot,
    affordances: Affordances,
    policy: Policy,
    protocol: Protocol,
    record: Callable[..., None],
    title: str = "evaluate",
    known: Mapping[TestRun, Sequence[Counts]] | None = None,
) -> dict[str, Any]:
    """Success rates on seen and unseen objects.

    A test run ends when the bin is truly empty or its attempts are spent.

    Args:
        robot: Reset to each canonical scene.
        affordances: The model, not changed.
        policy: The rule for picks; each test run starts with an empty memory.
        protocol: Counts.
        record: Called with each attempt and its split, policy, run, episode and scene_seed.
        title: Of the progress bar.
        known: Attempts of test runs that are not made again.

    Returns:
        By split: successes, attempts, rate, truth_successes and the same by run, as in ``result.json``.
    """
    most = protocol.runs * sum(protocol.attempts[split] for split in SPLITS)
    with tqdm(total=most, desc=title, disable=None) as bar:
        return {split: _split(robot, affordances, policy, protocol, split, record, bar, known or {}) for split in SPLITS}


def _split(
    robot: Robot,
    affordances: Affordances,
    policy: Policy,
    protocol: Protocol,
    split: Split,
    record: Callable[..., None],
    bar: tqdm,
    known: Mapping[TestRun, Sequence[Counts]],
) -> dict[str, Any]:
    runs, truths = [], 0
    for run in range(protocol.runs):
        seed, results = scene_seed(split, run, protocol.scenes), list(known.get((split, run), ()))
        if not results:
            for done in one_test_run(robot, affordances, policy.fresh(), seed, split, protocol.attempts[split]):
                record(done, split=split, policy=policy.name, run=run, episode=run, scene_seed=seed)
                results.append(Counts(done.outcome.success, done.outcome.truth, done.outcome.lost))
                bar.update()
        lost = sum(attempt.lost for attempt in results)
        successes = sum(attempt.success for attempt in results)
        truths += sum(attempt.truth for attempt in results)
        runs.append({"scene_seed": seed, "successes": successes, "attempts": len(results), "lost": lost})
    successes, attempts = (sum(run[k] for run in runs) for k in ("successes", "attempts"))
    rate = successes / attempts if attempts else 0.0
    return {"successes": successes, "attempts": attempts, "rate": rate, "truth_successes": truths, "runs": runs}


def one_test_run(
    robot: Robot, affordances: Affordances, policy: Policy, seed: int, split: Split, attempts: int
) -> Iterator[Attempt]:
    """One test run on the scene of ``seed``: attempts until the bin is truly empty or ``attempts`` are spent."""
    robot.reset(seed, split)
    for _ in range(attempts):
        if robot.bin_empty():
            return
        yield attempt(robot, affordances, policy)
