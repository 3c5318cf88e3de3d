"""What a reset leaves: how full the bin is, how much its objects touch, whether they are at rest and apart."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from benchmarks.common import arguments, at_least_one, finish, parsed, spread
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.experiment.results import SPLITS
from see2act.robot.oracle import ExactHeights
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.simulation import TIMESTEP
from see2act.robot.types import Split
from see2act.seeding import seed_for

TARGETS = {
    "coverage": (0.15, 0.45),
    "touching": (0.3, 1.0),
    "speed": (0.0, 0.01),
    "drift": (0.0, 0.0025),
    "overlap": (0.0, 0.001),
    "inside": (10, 10),
}
"""Least and most: shares of the floor and of the objects, m/s, metres within a quarter of a second, metres, objects."""


def measure(overrides: list[str], split: Split, first: int, resets: int) -> list[dict[str, Any]]:
    """One row a reset."""
    cfg = composed(overrides)
    robot = build.robot_factory(cfg, cfg.primitive)()
    rows = []
    for scene in range(first, first + resets):
        robot.rebuilds.clear()
        robot.reset(seed_for(f"scene/clutter/{split}", scene), split)
        rows.append(describe(robot) | {"refused": dict(robot.rebuilds)})
    robot.close()
    return rows


def describe(robot: SimulatedRobot) -> dict[str, Any]:
    """The scene as it lies, and how its objects move in a quarter of a second if all are awake."""
    client, bodies = robot.simulation.client, [body.id for body in robot.scene.bodies]
    solid = [*bodies, robot.scene.floor, *robot.scene.walls]
    overlap = 0.0
    for body in bodies:
        gaps = [point[8] for other in solid if other != body for point in client.getContactPoints(body, other)]
        overlap = max([overlap, *(-gap for gap in gaps)])
    at = np.array(list(robot.scene.positions().values()))
    half = np.array([robot.workspace.width, robot.workspace.length]) / 2
    coverage = float(np.isin(ExactHeights(robot).body, bodies).mean())
    robot.scene.wake()
    path = [at]
    for _ in range(5):
        for _ in range(12):
            robot.simulation.step()
        path.append(np.array(list(robot.scene.positions().values())))
    # Over a twentieth of a second: in single steps Bullet's contacts jump by some hundredths of a millimetre.
    speed = float(np.linalg.norm(np.diff(path, axis=0), axis=2).max() / (12 * TIMESTEP))
    drift = float(np.linalg.norm(path[-1] - at, axis=1).max())
    return {
        "coverage": coverage,
        "touching": robot.scene.touching(),
        "speed": speed,
        "drift": drift,
        "overlap": overlap,
        "inside": int((np.abs(at[:, :2]) < half).all(1).sum()),
    }


def main() -> None:
    """The command."""
    parser = arguments(__doc__)
    parser.add_argument("--resets", type=at_least_one, default=500, metavar="N", help="half of them a split (default 500)")
    args = parsed(parser)
    share = args.resets // 2
    jobs = [(args.overrides, split, i, min(25, share - i)) for split in SPLITS for i in range(0, share, 25)]
    scenes = [row for part in spread(measure, jobs, args.workers, "clutter") for row in part]
    rows: list[dict[str, Any]] = []
    for name, (least, most) in TARGETS.items():
        values = np.array([scene[name] for scene in scenes])
        met = (values >= least) & (values <= most)
        row = {"name": name, "resets": len(values), "mean": float(values.mean()), "least": float(values.min())}
        rows.append(row | {"most": float(values.max()), "target": f"{least:g} to {most:g}", "met in": int(met.sum())})
        rows[-1]["met"] = bool(met.all())
    refused = sum((Counter(scene["refused"]) for scene in scenes), Counter())
    finish(f"{len(scenes)} resets; scenes that were refused and dropped anew: {dict(refused)}", rows, args.json)


if __name__ == "__main__":
    main()
