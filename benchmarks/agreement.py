"""Whether what makes runs fast changes what they find: the same models on the same scenes, one setting changed at a time.

Vision models, transferred whole and not fine-tuned, come from the cache or are made now. Scenes are not those of evaluation.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchmarks.common import PRIMITIVES, arguments, at_least_one, finish, parsed, spread
from benchmarks.loop import SOURCES
from see2act.analysis.intervals import difference_interval
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.experiment.evaluation import EvaluationProtocol, evaluate
from see2act.experiment.results import SPLITS
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.pretrain import vision_model
from see2act.experiment.stages.transfer import affordance_model

SETTINGS = {
    "as the benchmark runs": [],
    "precision=fp32": ["precision=fp32"],
    "robot.motion=full": ["robot.motion=full"],
}
POINTS = 0.03
"""By which success rates may differ."""


def measure(overrides: list[str], primitive: str, setting: str, runs: int) -> dict[str, Any]:
    """Successes and attempts of ``runs`` test runs a split; the model is that of the settings without the change."""
    torch.set_num_threads(1)
    base = [*overrides, f"primitive={primitive}", f"task={SOURCES[primitive]}", "transfer=full", "logger=none"]
    with TemporaryDirectory() as scratch:
        cfg = composed(base)
        collection = collected(cfg)
        vision = vision_model(cfg, collection, partial(build.trainer, cfg, Path(scratch), None))
        module, _ = affordance_model(cfg, collection, vision)
    cfg = composed([*base, *SETTINGS[setting]])
    module.network.set_precision(cfg.precision)
    robot = build.robot_factory(cfg, cfg.primitive)()
    protocol = EvaluationProtocol(runs, dict(cfg.evaluate.attempts), scenes="develop")
    result = evaluate(robot, module.affordances, build.policy(cfg), protocol, lambda attempt, test: None)
    robot.close()
    counts = {key: sum(getattr(result[split], key) for split in SPLITS) for key in ("successes", "attempts")}
    return {"primitive": primitive, "setting": setting, **counts, "rate": counts["successes"] / counts["attempts"]}


def compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with their difference from the first of the same primitive, and its 95 % interval."""
    first: dict[str, dict[str, Any]] = {}
    for row in rows:
        base = first.setdefault(row["primitive"], row)
        counts = row["successes"], row["attempts"], base["successes"], base["attempts"]
        low, high = difference_interval(*counts)
        row |= {"difference": row["rate"] - base["rate"], "low": low, "high": high, "target": f"+- {POINTS}"}
        row["met"] = abs(row["difference"]) <= POINTS if row is not base else None
    return rows


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=at_least_one, default=15, metavar="N", help="test runs a split (default 15)")
    parser.add_argument("--primitives", nargs="+", choices=PRIMITIVES, default=PRIMITIVES)
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS)[1:], default=list(SETTINGS)[1:])
    args = parsed(parser)
    settings = [name for name in SETTINGS if name in args.settings or not SETTINGS[name]]
    jobs = [(args.overrides, primitive, setting, args.runs) for primitive in args.primitives for setting in settings]
    measure(args.overrides, jobs[0][1], jobs[0][2], 1)  # fills the cache before several want it
    finish("Agreement", compared(list(spread(measure, jobs, args.workers, "agreement"))), args.json)


if __name__ == "__main__":
    main()
