"""Whether decisions are those of the plain network: the shipped models on scenes of the robot, as runs compute against fp32.

The plain way is single precision, one rotation after the other, as a network comes. It is compared with `precision=`,
by default what runs take on this processor.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from scipy.special import expit

from benchmarks.common import PRIMITIVES, arguments, at_least_one, finish, parsed, spread
from see2act.commands.demo import MODELS
from see2act.experiment import build, model_file
from see2act.experiment.config import composed
from see2act.experiment.evaluation import scene_seed
from see2act.experiment.results import SPLITS, wilson
from see2act.modules.affordance import affordances
from see2act.modules.rotation import Rotations

LOOKS = 10
"""Observations of a scene, which differ by the sensor's noise."""
SAME = 0.99
"""Least share of decisions for the same pixel and angle."""


def compare(overrides: list[str], primitive: str, first: int, looks: int) -> dict[str, Any]:
    """Decisions on ``looks`` observations, ten of a scene, from the ``first`` scene on."""
    torch.set_num_threads(1)
    cfg = composed([*overrides, f"primitive={primitive}"])
    plain = model_file.load(MODELS / f"{primitive}.safetensors", primitive).network.to(memory_format=torch.contiguous_format)
    plain._layout = torch.contiguous_format
    fast = copy.deepcopy(plain)
    fast.set_precision(cfg.precision)
    robot = build.robot_factory(cfg, cfg.primitive)()
    rotations = Rotations(robot.workspace.shape, cfg.primitive.angles, plain.stride, plain.receptive_radius)
    row: dict[str, Any] = {"primitive": primitive, "precision": cfg.precision, "decisions": 0, "same": 0}
    apart, lost = [], []
    for look in range(looks):
        if look % LOOKS == 0:
            run = first + look // LOOKS
            robot.reset(scene_seed(SPLITS[run % 2], run, "develop"), SPLITS[run % 2])
        heightmap = robot.observe().heightmap
        ours, exact = (
            expit(affordances(network, rotations, heightmap.color, heightmap.height).astype(float)) for network in (fast, plain)
        )
        row["decisions"] += 1
        row["same"] += int(ours.argmax() == exact.argmax())
        apart.append(float(np.abs(ours - exact).max()))
        lost.append(float(exact.max() - exact.ravel()[ours.argmax()]))
    robot.close()
    return row | {"scores_differ_at_most": max(apart), "score_lost_at_most": max(lost)}


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--decisions", type=at_least_one, default=300, metavar="N", help="of each primitive (default 300)")
    parser.add_argument("--primitives", nargs="+", choices=PRIMITIVES, default=PRIMITIVES)
    args = parsed(parser)
    share = 5 * LOOKS
    jobs = [
        (args.overrides, primitive, i // LOOKS, min(share, args.decisions - i))
        for primitive in args.primitives
        for i in range(0, args.decisions, share)
    ]
    parts = list(spread(compare, jobs, args.workers, "decisions"))
    rows = []
    for primitive in args.primitives:
        mine = [part for part in parts if part["primitive"] == primitive]
        row = mine[0] | {name: sum(part[name] for part in mine) for name in ("decisions", "same")}
        row |= {name: max(part[name] for part in mine) for name in ("scores_differ_at_most", "score_lost_at_most")}
        low, high = wilson(row["same"], row["decisions"])
        rows.append(row | {"low": low, "high": high, "target": f">= {SAME}", "met": row["same"] >= SAME * row["decisions"]})
    finish("Decisions as runs make them, against the plain network", rows, args.json)


if __name__ == "__main__":
    main()
