"""``attempts.csv``: a row for every attempt of a run, appended as it happens. One schema for writer and readers."""

from __future__ import annotations

import csv
import gzip
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

from see2act.errors import DamagedFile
from see2act.files import replacing
from see2act.robot.types import Split

if TYPE_CHECKING:
    from see2act.attempt import Attempt  # brings the whole robot, which readers of the file do not need

Phase = Literal["zero_shot", "finetune", "eval", "aborted"]
"""``aborted``: a training attempt of a real robot that was not carried through; nothing counts it."""


TESTED: tuple[Phase, ...] = ("zero_shot", "eval")
"""Phases of evaluations."""


@dataclass(frozen=True)
class Place:
    """Where an attempt belongs in its run."""

    phase: Phase
    split: Split
    policy: str
    run: int
    """Test run; 0 while learning."""
    step: int
    """Fine-tuning attempts so far, this one included while learning."""
    episode: int
    scene_seed: int
    primitive: str


@dataclass(frozen=True)
class AttemptRow(Place):
    """A row; its fields are the columns in their order."""

    row: int
    col: int
    angle: float
    """Radians."""
    x: float
    """Metres, as ``y`` and ``z``."""
    y: float
    z: float
    score: float
    """Predicted probability of success."""
    explore: bool
    """Whether another pick than the best was drawn."""
    entropy: float
    """Nats of the distribution that the pick was drawn from."""
    success: bool
    """As the robot senses it."""
    truth: bool | None
    """As the simulator knows it; empty where nobody does."""
    cause: str
    """``ok``, or why it failed."""
    lost: int
    """Objects that left the bin without being picked."""
    robot_seconds: float
    """What the motion takes at the configured joint speed."""
    t_observe: float
    """Wall seconds, as the others that begin with ``t_``."""
    t_decide: float
    t_act: float
    t_learn: float
    t_total: float

    @classmethod
    def of(cls, attempt: Attempt, place: Place, t_learn: float = 0.0) -> AttemptRow:
        """The row of an attempt."""
        pick, choice, outcome = attempt.pick, attempt.choice, attempt.outcome
        times = (attempt.t_observe, attempt.t_decide, attempt.t_act, t_learn)
        return cls(
            **asdict(place),
            row=pick.row,
            col=pick.col,
            angle=pick.angle,
            x=pick.x,
            y=pick.y,
            z=pick.z,
            score=choice.score,
            explore=choice.explored,
            entropy=choice.entropy,
            success=outcome.success,
            truth=outcome.truth,
            cause=outcome.cause,
            lost=outcome.lost,
            robot_seconds=outcome.robot_seconds,
            t_observe=times[0],
            t_decide=times[1],
            t_act=times[2],
            t_learn=times[3],
            t_total=sum(times),
        )

    @classmethod
    def parse(cls, texts: dict[str, str]) -> AttemptRow:
        """From the text of each column.

        Raises:
            KeyError: A column is missing.
            ValueError: A text is not what its column holds.
        """
        values: dict[str, Any] = {name: _PARSERS[kind](texts[name]) for name, kind in _KINDS.items()}
        return cls(**values)

    def texts(self) -> dict[str, str]:
        """The text of each column."""
        return {name: _text(name, getattr(self, name)) for name in COLUMNS}


COLUMNS = tuple(field.name for field in fields(AttemptRow))
DECIMALS = {"angle": 6, "x": 5, "y": 5, "z": 6, "score": 6, "entropy": 4, "robot_seconds": 3}
"""Of floating-point columns; times have four."""
_KINDS = {name: kind for name, kind in get_type_hints(AttemptRow).items() if name in COLUMNS}
_PARSERS: dict[object, Callable[[str], object]] = {
    str: str,
    int: int,
    float: float,
    bool: lambda text: bool(int(text)),
    bool | None: lambda text: bool(int(text)) if text else None,
    Phase: str,
    Split: str,
}


def _text(name: str, value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:.{DECIMALS.get(name, 4)}f}" if _KINDS[name] is float else str(value)


class AttemptsCsv:
    """Appends rows, one write each, so that a killed run keeps all but the row being written.

    Args:
        path: The file.
    """

    def __init__(self, path: Path):
        self.path = path

    def begin(self, keep: Callable[[AttemptRow], bool] = lambda row: False) -> None:
        """Write the header.

        Args:
            keep: Which rows of an earlier, interrupted run stay.

        Raises:
            DamagedFile: What is there is no log of attempts.
        """
        try:
            rows = [row for row in read(self.path) if keep(row)] if self.path.exists() else []
        except UNREADABLE as error:
            raise DamagedFile(
                f"{self.path} is damaged ({fault(error)}): move the folder of its run away, and type the same command again"
            ) from None
        with replacing(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(row.texts() for row in rows)

    def append(self, *rows: AttemptRow) -> None:
        """Add rows."""
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerows(row.texts() for row in rows)


UNREADABLE = (OSError, EOFError, zlib.error, ValueError, LookupError, TypeError, csv.Error)
"""What reading attempts may raise."""


def fault(error: Exception) -> str:
    """What is wrong with a file of attempts, in a few words."""
    return f"there is no column {error}" if isinstance(error, KeyError) else " ".join(str(error).split())


def read(path: Path) -> list[AttemptRow]:
    """Complete rows of the file, which may be compressed (.gz); one cut short by a kill is left out.

    Raises:
        UNREADABLE: It is not what a run writes.
    """
    with gzip.open(path, "rt", newline="") if path.suffix == ".gz" else path.open(newline="") as file:
        return [AttemptRow.parse(texts) for texts in csv.DictReader(file) if texts[COLUMNS[-1]] is not None]
