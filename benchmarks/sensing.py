"""Whether what the robot senses is true: sensed success against the simulator's, on easy picks and on nasty ones.

Kinds of attempt: the oracle's `best`; a `random` pixel on an object; a `tilted` one, where its surface slopes; the `edge` of
what the oracle would pick, where cups leak and fingers pinch; `knocked`, an object pushed sideways somewhere on its way up;
`heavy`, one of a mass that the tool can just or just not bear.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

from benchmarks.common import PRIMITIVES, arguments, at_least_one, finish, parsed, spread
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.experiment.results import SPLITS
from see2act.robot.oracle import ExactHeights, oracle
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Pick
from see2act.seeding import generator, seed_for

KINDS = ("best", "random", "tilted", "edge", "knocked", "heavy")
PER_SCENE = 10
LIMIT = 0.02
"""Most false positives (of true failures) and false negatives (of true picks)."""
ENOUGH = 200
"""True picks and true failures of a primitive that a verdict needs."""
SLOPE = np.radians((12, 40))
"""Radians."""
EDGE = (0.005, 0.02)
"""Metres that a pick is off the oracle's."""
PUSH = (2.0, 40.0)
"""Newtons, for an eighth of a second."""
RISEN = (0.01, 0.09)
"""Metres above its place at which an object is pushed; the lift is 0.10."""
MASS = (0.5, 5.0)
"""Kilograms."""


def measure(overrides: list[str], primitive: str, kind: str, first: int, wanted: int) -> dict[str, Any]:
    """At least ``wanted`` attempts of a kind."""
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    scores = oracle(robot, cfg.primitive.angles)
    counted = ("attempts", "true", "held_then_lost", "false_negatives", "false_positives")
    row: dict[str, Any] = {"primitive": primitive, "kind": kind, **dict.fromkeys(counted, 0)}
    for scene in count(first):
        rng = generator(f"benchmarks/sensing/{primitive}/{kind}", scene)
        robot.reset(seed_for(f"scene/sensing/{primitive}/{kind}", scene), SPLITS[scene % 2])
        for _ in range(PER_SCENE):
            if robot.bin_empty() or row["attempts"] >= wanted:
                break
            pick = _pick(robot, scores, cfg.primitive.angles, kind, rng)
            if kind == "heavy":
                for body in robot.scene.bodies:
                    robot.simulation.client.changeDynamics(body.id, -1, mass=np.exp(rng.uniform(*np.log(MASS))))
            robot.simulation.after_step = _pusher(robot, rng) if kind == "knocked" else None
            outcome = robot.execute(pick)
            robot.simulation.after_step = None
            row["attempts"] += 1
            row["true"] += outcome.truth
            row["held_then_lost"] += outcome.cause == "slipped" and not outcome.truth
            row["false_negatives"] += outcome.truth and not outcome.success
            row["false_positives"] += outcome.success and not outcome.truth
        if row["attempts"] >= wanted:
            break
    robot.close()
    return row


def _pick(robot: SimulatedRobot, scores: Callable[..., np.ndarray], angles: int, kind: str, rng: np.random.Generator) -> Pick:
    heightmap = robot.observe().heightmap
    rows, cols = heightmap.height.shape
    if kind in ("random", "tilted"):
        on_objects = robot.truth().body >= 0
        slope = np.arctan(np.hypot(*np.gradient(ExactHeights(robot).height, robot.workspace.pixel)))
        tilted = on_objects & (slope > SLOPE[0]) & (slope < SLOPE[1])
        cells = np.argwhere(tilted if kind == "tilted" and tilted.any() else on_objects)
        row, col = cells[rng.integers(len(cells))] if len(cells) else (rows // 2, cols // 2)
        angle = rng.integers(angles)
    else:
        logits = scores(heightmap.color, heightmap.height)
        angle, row, col = np.unravel_index(logits.argmax(), logits.shape)
    if kind == "edge":
        turn = rng.uniform(0, 2 * np.pi)
        off = rng.uniform(*EDGE) / robot.workspace.pixel
        row = np.clip(round(row + off * np.sin(turn)), 5, rows - 6)
        col = np.clip(round(col + off * np.cos(turn)), 5, cols - 6)
    return robot.workspace.pick(heightmap, int(row), int(col), float(angle) * np.pi / angles)


def _pusher(robot: SimulatedRobot, rng: np.random.Generator) -> Callable[[], None]:
    """Pushes the first object that has risen so far, once."""
    before, turn, steps = robot.scene.positions(), rng.uniform(0, 2 * np.pi), 30
    risen = rng.uniform(*RISEN)
    force = rng.uniform(*PUSH) * np.array([np.cos(turn), np.sin(turn), 0])

    def push() -> None:
        nonlocal steps
        for body, at in robot.scene.positions().items():
            if steps and at[2] - before[body][2] > risen:
                steps -= 1
                robot.simulation.client.applyExternalForce(body, -1, force, at, robot.simulation.client.WORLD_FRAME)
                return

    return push


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--attempts", type=at_least_one, default=90, metavar="N", help="of each kind (default 90)")
    parser.add_argument("--primitives", nargs="+", choices=PRIMITIVES, default=PRIMITIVES)
    args = parsed(parser)
    jobs = [(args.overrides, primitive, kind, 0, args.attempts) for primitive in args.primitives for kind in KINDS]
    rows = list(spread(measure, jobs, args.workers, "sensing"))
    for primitive in args.primitives:
        parts = [row for row in rows if row["primitive"] == primitive and row["kind"] in KINDS]
        total = {"primitive": primitive, "kind": "all"} | {name: sum(row[name] for row in parts) for name in list(parts[0])[2:]}
        rows.append(total)
    for row in rows:
        failures = row["attempts"] - row["true"]
        enough = min(row["true"], failures) >= ENOUGH
        wrong = row["false_negatives"] / max(row["true"], 1), row["false_positives"] / max(failures, 1)
        row |= {"false_negative_rate": wrong[0], "false_positive_rate": wrong[1]}
        row["met"] = enough and max(wrong) <= LIMIT if row["kind"] == "all" else None
    finish(f"Sensed against true (at most {LIMIT:.0%} of each error over all kinds)", rows, args.json)


if __name__ == "__main__":
    main()
