"""``result.json``: what a finished run says of itself. One schema for the run that writes it and for whoever reads it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt
from pydantic import BaseModel, ConfigDict, StrictInt, model_validator

from see2act.errors import DamagedFile
from see2act.experiment import attempts
from see2act.experiment.identity import CHOICES, WORD
from see2act.files import read_json, write_json
from see2act.robot.types import Split

SPLITS: tuple[Split, ...] = ("seen", "unseen")
PHASES: tuple[Literal["zero_shot", "eval", "eval_argmax"], ...] = ("zero_shot", "eval", "eval_argmax")
BLOCK = 20
"""Fine-tuning attempts in a point of the learning curve."""
RATE_ERROR = 1e-6
Count = Annotated[StrictInt, Ge(0)]


def wilson(successes: int, attempts: int) -> tuple[float, float]:
    """95 % Wilson score interval of a binomial rate (Wilson 1927); (0, 1) without attempts.

    Raises:
        ValueError: More successes than attempts, or a negative count.
    """
    if not 0 <= successes <= attempts:
        raise ValueError(f"{successes} successes of {attempts} attempts are impossible")
    if attempts == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest  # here, because its import takes a second

    interval = binomtest(successes, attempts).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


class Record(BaseModel):
    """Part of a result. Keys that a reader does not know are ignored, so that newer files can be read."""

    model_config = ConfigDict(frozen=True)


class Counts(Record):
    """Successes among attempts."""

    successes: Count
    attempts: Annotated[StrictInt, Gt(0)]

    @property
    def success_rate(self) -> float:
        """Successes per attempt."""
        return self.successes / self.attempts

    @model_validator(mode="after")
    def _possible(self) -> Counts:
        if self.successes > self.attempts:
            raise ValueError(f"{self.successes} successes of {self.attempts} attempts")
        return self


class RunCounts(Counts):
    """One test run: a bin that is emptied as far as its attempts allow."""

    scene_seed: int
    lost: Count = 0
    """Objects that left the bin without being held."""


class SplitCounts(Counts):
    """All test runs with seen, or with unseen objects."""

    rate: float
    truth_successes: Count | None
    """Successes by the simulator's truth; ``successes`` are as the robot senses them. None where nobody knows."""
    runs: tuple[RunCounts, ...]

    @classmethod
    def of(cls, runs: Sequence[RunCounts], truth_successes: int | None) -> SplitCounts:
        """The sum of test runs."""
        successes, attempts = (sum(getattr(run, key) for run in runs) for key in ("successes", "attempts"))
        return cls(
            successes=successes,
            attempts=attempts,
            rate=successes / attempts,
            truth_successes=truth_successes,
            runs=tuple(runs),
        )

    @model_validator(mode="after")
    def _add_up(self) -> SplitCounts:
        successes, attempts = (sum(getattr(run, key) for run in self.runs) for key in ("successes", "attempts"))
        if (successes, attempts) != (self.successes, self.attempts):
            raise ValueError(f"test runs sum up to {successes}/{attempts}, not {self.successes}/{self.attempts}")
        if not abs(self.rate - self.success_rate) < RATE_ERROR:  # a rate that is no number is wrong too
            raise ValueError(f"rate {self.rate} is not {self.successes}/{self.attempts}")
        return self


class Evaluation(Record):
    """Success by the protocol, by split."""

    seen: SplitCounts
    unseen: SplitCounts
    repeated: bool = False
    """Whether another evaluation of the same run was taken, since nothing had changed."""

    def __getitem__(self, split: Split) -> SplitCounts:
        counts: SplitCounts = getattr(self, split)
        return counts


class StepEvaluation(Evaluation):
    """The same after some fine-tuning attempts."""

    step: Count


class Block(Counts):
    """A point of the learning curve."""

    step: Count
    """Attempts up to here."""


class VisionQuality(Record):
    """How good the vision model is."""

    positive_share: float
    """Share of pixels that are labelled positive."""
    val_loss: float
    average_precision: float
    """On held-out scenes."""


class RunResult(Record):
    """Everything that ``result.json`` holds."""

    choices: dict[str, Any]
    """Names of the configuration's choices, and the seed."""
    config_hash: str
    versions: dict[str, str]
    earlier_versions: tuple[dict[str, str], ...] = ()
    """Those that worked at it before, oldest first, where a run of an attended robot was continued by another version."""
    commit: str | None = None
    seconds: dict[str, float]
    """Wall time by stage."""
    evaluation_share: float = 0.0
    """Of these seconds."""
    vision: VisionQuality | None = None
    zero_shot: Evaluation | None = None
    """Before the first attempt; None where a person would have had to fill the bin for it and was not asked to."""
    eval: Evaluation
    """After the last attempt."""
    eval_argmax: Evaluation | None = None
    """The same with the plain argmax policy; None where it was not asked for."""
    evals: tuple[StepEvaluation, ...]
    curve: tuple[Block, ...]

    @model_validator(mode="after")
    def _consistent(self) -> RunResult:
        if not all(re.fullmatch(WORD, str(self.choices.get(key, ""))) for key in CHOICES):
            raise ValueError("choices are no words")
        if not isinstance(self.choices.get("seed"), int):
            raise ValueError(f"seed {self.choices.get('seed')} is no number")
        if not self.versions:
            raise ValueError("versions are missing")
        points = [*filter(None, map(self.phase, PHASES)), *self.evals]
        if len({len(point[split].runs) for point in points for split in SPLITS}) > 1:
            raise ValueError("its evaluations have different numbers of test runs")
        if [block.step for block in self.curve] != [*accumulate(block.attempts for block in self.curve)]:
            raise ValueError("the steps of its curve are not what its attempts sum up to")
        steps = [point.step for point in self.evals]
        if not steps or steps != sorted({*steps}):
            raise ValueError("evals are missing, or not in order")
        return self

    @property
    def seed(self) -> int:
        """Of fine-tuning."""
        return int(self.choices["seed"])

    def phase(self, name: str) -> Evaluation | None:
        """One of ``PHASES``; None if it was not evaluated then."""
        evaluation: Evaluation | None = getattr(self, name)
        return evaluation

    @property
    def outcomes(self) -> dict[str, Any]:
        """All but how long it took, and by which of several commits with the same code."""
        return self.model_dump(mode="json", exclude={"seconds", "evaluation_share", "commit"})


def write_result(path: Path, result: RunResult) -> None:
    """Write atomically: the presence of the file means that the run is finished."""
    write_json(path, result.model_dump(mode="json"))


def read_result(path: Path) -> RunResult:
    """Read what :func:`write_result` wrote.

    Raises:
        DamagedFile: It is no such file.
    """
    data = read_json(path)
    try:
        return RunResult.model_validate(data)
    except ValueError as error:
        raise DamagedFile(f"{path} is damaged ({first_problem(error)}): delete it and type the same command again") from None


def first_problem(error: ValueError) -> str:
    """What is wrong first, in a few words."""
    errors = getattr(error, "errors", None)
    if errors is None:
        return " ".join(str(error).split())
    problem = errors()[0]
    where = ".".join(map(str, problem["loc"]))
    words = str(problem["msg"]).removeprefix("Value error, ")
    return f"{where}: {words}" if where else words


def curve(rows: Iterable[attempts.AttemptRow]) -> tuple[Block, ...]:
    """Successes of fine-tuning attempts in consecutive blocks; the last one may be shorter."""
    outcomes = [row.success for row in rows if row.phase == "finetune"]
    blocks = [outcomes[i : i + BLOCK] for i in range(0, len(outcomes), BLOCK)]
    ends = accumulate(len(block) for block in blocks)
    return tuple(Block(step=end, successes=sum(block), attempts=len(block)) for end, block in zip(ends, blocks, strict=True))
