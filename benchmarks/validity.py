"""How much room the benchmark leaves: scripted policies under the paper's evaluation protocol.

An oracle that knows the scene should pick nearly always, and a random pixel rarely. `--policies trained` sends the models that
are in `models/`, to see what they make of other objects (`objects=random_urdfs`). `--policies heuristic` is what a user would
try first: distance of colour from the floor for suction, an antipodal rule on heights for grasping.
`--scenes develop` takes other scenes than evaluation does: use it while changing the scene, the tools or
the objects.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import count
from typing import Any

import numpy as np
import torch

from benchmarks.common import PRIMITIVES, arguments, at_least_one, parsed, show, spread
from benchmarks.heuristics import heuristic
from see2act.attempt import Affordances
from see2act.commands.demo import MODELS
from see2act.experiment import build, model_file
from see2act.experiment.config import composed
from see2act.experiment.evaluation import one_test_run, scene_seed
from see2act.experiment.results import SPLITS, wilson
from see2act.files import write_json
from see2act.policy import Policy
from see2act.robot.oracle import ExactHeights, oracle
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Split
from see2act.seeding import generator

TARGETS = {("oracle", "suction"): 0.95, ("oracle", "grasp"): 0.92, ("random", "suction"): 0.15, ("random", "grasp"): 0.20}
"""The oracle at least, a random pixel at most."""
PER_OBJECT = 0.85
SCRIPTED = ("oracle", "random", "random_foreground")
HEURISTIC, TRAINED = "heuristic", "trained"


def measure(overrides: list[str], primitive: str, split: Split, policy: str, scenes: str, wanted: int) -> dict[str, Any]:
    """Test runs until at least ``wanted`` attempts were made."""
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    rule = build.policy(cfg)
    if policy == TRAINED:
        torch.set_num_threads(1)
        scores: Affordances = model_file.load(MODELS / f"{primitive}.safetensors", primitive).affordances
    else:
        scores, rule = _scripted(policy, robot, cfg.primitive.angles, rule)
    objects: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    aimed: list[np.ndarray] = []
    names: dict[int, str] = {}

    def looking(color: np.ndarray, height: np.ndarray) -> np.ndarray:
        if policy == "oracle":  # who lies where, before the attempt changes it
            names.update({body.id: body.name for body in robot.scene.bodies})
            aimed[:] = [ExactHeights(robot).body]
        return scores(color, height)

    successes = attempts = left = lost = 0
    for run in count():
        if attempts >= wanted:
            break
        seed = scene_seed(split, run, scenes)
        for done in one_test_run(robot, looking, rule.fresh(), seed, split, cfg.evaluate.attempts[split]):
            if policy == "oracle":
                name = names.get(int(aimed[0][done.choice.row, done.choice.col]), "floor")
                objects[name][0] += done.outcome.success
                objects[name][1] += 1
            successes += done.outcome.success
            attempts += 1
            lost += done.outcome.lost
        left += len(robot.scene.bodies)
    robot.close()
    low, high = wilson(successes, attempts)
    row: dict[str, Any] = {
        "primitive": primitive,
        "split": split,
        "policy": policy,
        "successes": successes,
        "attempts": attempts,
    }
    row |= {"rate": successes / attempts, "low": low, "high": high, "runs": run, "left": left, "lost": lost}
    return row | {"objects": dict(sorted(objects.items()))}


def _scripted(policy: str, robot: SimulatedRobot, angles: int, rule: Policy) -> tuple[Affordances, Policy]:
    if policy == "oracle":
        return oracle(robot, angles), rule
    if policy == HEURISTIC:
        return heuristic(robot, angles), rule
    rng = generator(f"benchmarks/{policy}")

    def anywhere(color: np.ndarray, height: np.ndarray) -> np.ndarray:
        return rng.random((angles, *height.shape))

    def on_objects(color: np.ndarray, height: np.ndarray) -> np.ndarray:
        return anywhere(color, height) + (robot.truth().body >= 0)

    return (anywhere if policy == "random" else on_objects), rule.plain()


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--attempts", type=at_least_one, default=200, metavar="N", help="at least so many a row (default 200)")
    parser.add_argument("--scenes", choices=("evaluate", "develop"), default="evaluate")
    parser.add_argument("--policies", nargs="+", choices=(*SCRIPTED, HEURISTIC, TRAINED), default=SCRIPTED)
    parser.add_argument("--primitives", nargs="+", choices=(*PRIMITIVES, "grasp_rg2"), default=PRIMITIVES)
    args = parsed(parser)
    jobs = [
        (args.overrides, primitive, split, policy, args.scenes, args.attempts)
        for policy in args.policies
        for primitive in args.primitives
        for split in SPLITS
    ]
    rows = list(spread(measure, jobs, args.workers, "validity"))
    for row in rows:
        target = TARGETS.get((row["policy"], row["primitive"]))
        row["target"], row["met"] = target, None
        if target is not None:
            row["met"] = row["rate"] >= target if row["policy"] == "oracle" else row["rate"] <= target
    show("Policies", [{k: v for k, v in row.items() if k != "objects"} for row in rows])
    by_object = [
        {
            "primitive": row["primitive"],
            "object": name,
            "successes": s,
            "attempts": n,
            "rate": s / n,
            "met": s / n >= PER_OBJECT,
        }
        for row in rows
        if row["policy"] == "oracle"
        for name, (s, n) in row["objects"].items()
    ]
    if by_object:
        show(f"The oracle by object (at least {PER_OBJECT})", by_object)
    if args.json:
        write_json(args.json, rows)


if __name__ == "__main__":
    main()
