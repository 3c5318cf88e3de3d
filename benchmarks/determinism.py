"""Whether the same seeds and picks give the same pictures and outcomes, bit for bit, whatever else the machine does.

Two processes play the same scenes one after the other: the first on a machine left alone, the second, which plays the
scenes in reverse order, while other processes keep every core busy.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.common import PRIMITIVES, arguments, at_least_one, finish, parsed, pool_of
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.seeding import generator, seed_for

PICKS = 5
"""In each scene, on random pixels of objects."""


def play(overrides: list[str], primitive: str, scenes: list[int]) -> dict[int, list[str]]:
    """For each scene a line per pick: a hash of what was seen, exact and sensed, and the outcome with all its digits."""
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    lines: dict[int, list[str]] = {}
    for scene in scenes:
        rng = generator("benchmarks/determinism", scene)
        robot.reset(seed_for("scene/determinism", scene), "seen")
        lines[scene] = []
        for _ in range(PICKS):
            truth, observation = robot.truth(), robot.observe()
            heightmap = observation.heightmap
            cells = np.argwhere(truth.body >= 0)
            row, col = cells[rng.integers(len(cells))]
            angle = rng.integers(cfg.primitive.angles) * np.pi / cfg.primitive.angles
            outcome = robot.execute(robot.workspace.pick(heightmap, int(row), int(col), float(angle)))
            seen = (heightmap.height, heightmap.color, heightmap.valid, observation.depth, truth.heightmap.height)
            digest = hashlib.sha256(b"".join(array.tobytes() for array in seen)).hexdigest()[:16]
            lines[scene].append(f"{digest} {outcome}")
    robot.close()
    return lines


def compare(overrides: list[str], primitive: str, scenes: int) -> dict[str, Any]:
    """Play in two processes and count the picks that agree in every bit."""
    order = list(range(scenes))
    with pool_of(1) as pool:
        alone = pool.submit(play, overrides, primitive, order).result()
    with _every_core_busy(), pool_of(1) as pool:
        crowded = pool.submit(play, overrides, primitive, order[::-1]).result()
    same = sum(a == b for scene in order for a, b in zip(alone[scene], crowded[scene], strict=True))
    successes = sum("success=True" in line for lines in alone.values() for line in lines)
    picks = scenes * PICKS
    return {"primitive": primitive, "picks": picks, "successes": successes, "identical": same, "met": same == picks}


@contextmanager
def _every_core_busy() -> Iterator[None]:
    burners = [get_context("spawn").Process(target=_burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    try:
        for burner in burners:
            burner.start()
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.join()


def _burn() -> None:
    while True:
        pass


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--scenes", type=at_least_one, default=20, metavar="N", help="of five picks each (default 20)")
    args = parsed(parser)
    rows = [compare(args.overrides, primitive, args.scenes) for primitive in PRIMITIVES]
    finish("The same picks in two processes, one of them on busy cores", rows, args.json)


if __name__ == "__main__":
    main()
