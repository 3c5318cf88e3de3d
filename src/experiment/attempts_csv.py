"""``attempts.csv``: a row for every attempt of a run, appended as it happens."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from see2act.files import replacing

if TYPE_CHECKING:
    from see2act.attempt import Attempt  # brings the whole robot, which readers of the file do not need

COLUMNS = (
    *("phase", "split", "policy", "run", "step", "episode", "scene_seed", "primitive"),
    *("row", "col", "angle", "x", "y", "z", "score", "explore", "entropy"),
    *("success", "truth", "cause", "lost", "robot_seconds"),
    *("t_observe", "t_decide", "t_act", "t_learn", "t_total"),
)
TIMES = COLUMNS[-5:]


class AttemptsCsv:
    """Appends rows, one write each, so that a killed run keeps all but the row being written.

    Args:
        path: The file.
        keep: Which rows of an earlier, interrupted run stay.
    """

    def __init__(self, path: Path, keep: Callable[[dict[str, str]], bool]):
        self._path = path
        rows = [row for row in read(path) if keep(row)] if path.exists() else []
        with replacing(path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)

    def append(self, attempt: Attempt, t_learn: float = 0.0, **where: Any) -> dict[str, Any]:
        """Add an attempt; ``where`` gives phase, split, policy, run, step, episode, scene_seed and primitive.

        Returns:
            Its row.
        """
        pick, outcome = attempt.pick, attempt.outcome
        times = (attempt.t_observe, attempt.t_decide, attempt.t_act, t_learn)
        row = {
            **where,
            **{"row": pick.row, "col": pick.col, "angle": f"{pick.angle:.6f}"},
            **{"x": f"{pick.x:.5f}", "y": f"{pick.y:.5f}", "z": f"{pick.z:.6f}"},
            **{"score": f"{attempt.choice.score:.6f}", "explore": int(attempt.choice.explored)},
            **{"entropy": f"{attempt.choice.entropy:.4f}"},
            **{"success": int(outcome.success), "truth": int(outcome.truth), "cause": outcome.cause},
            "lost": outcome.lost,
            "robot_seconds": f"{outcome.robot_seconds:.3f}",
            **{name: f"{value:.4f}" for name, value in zip(TIMES, (*times, sum(times)), strict=True)},
        }
        self.extend([row])
        return row

    def extend(self, rows: list[dict[str, Any]]) -> None:
        """Add rows as they are."""
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerows(rows)


def read(path: Path) -> list[dict[str, str]]:
    """Complete rows of the file, which may be compressed (.gz); one cut short by a kill is left out."""
    with gzip.open(path, "rt", newline="") if path.suffix == ".gz" else path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["t_total"] is not None]
