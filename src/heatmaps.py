"""The paper's figure of heatmaps: the same observations through every source model, and through a fine-tuned one.

Collected data and vision models come from the cache, or are made now as train.py would make them. Source models whose
weights are not here are left out and named.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from omegaconf import OmegaConf
from see2act.config import ConfigError, composed, validate

TASKS = ("none", "imagenet", "edge", "corner", "center", "foreground", "normal", "coco")
TRANSFERS = {"none": "none", "imagenet": "backbone"}
"""What is copied for the figure; everything else is copied whole."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, metavar="DIR", help="a finished run whose fine-tuned model is shown last")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, metavar="TASK", help=f"of {', '.join(TASKS)}")
    parser.add_argument("--scenes", type=int, default=1, metavar="N", help="of each split (default 1)")
    parser.add_argument("--out", type=Path, default=Path("heatmaps"), metavar="DIR", help="default: heatmaps/")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py")
    args = parser.parse_args(arguments)
    try:
        missing = draw(args.overrides, args.tasks, args.run, args.scenes, args.out)
    except ConfigError as error:
        sys.exit(f"see2act: {error}")
    for task, reason in missing.items():
        print(f"left out: {task}: {reason}")
    print(args.out / "heatmaps.png")


def draw(overrides: Sequence[str], tasks: Sequence[str], run: Path | None, scenes: int, out: Path) -> dict[str, str]:
    """Make the figure in ``out``; what had to be left out, with the reason.

    Raises:
        ConfigError: The configuration is impossible, or the run's model is another one.
    """
    import torch  # torch and lightning take seconds, which --help should not
    from see2act import build, figures
    from see2act.modules.transfer import TransferError
    from see2act.pipeline import Run

    models, missing = {}, {}
    last = run / "checkpoints" / "affordance.ckpt" if run else None
    if run and last and not last.is_file():
        raise ConfigError(f"{last} is not there: --run takes the folder of a finished run")
    overrides = [*(_of_run(run, overrides) if run else ()), *overrides]
    with TemporaryDirectory() as scratch:
        for task in tasks:
            cfg = composed([*overrides, f"task={task}", f"transfer={TRANSFERS.get(task, 'full')}"])
            torch.set_num_threads(cfg.threads)
            job = Run(cfg, Path(scratch) / task)
            try:
                validate(cfg)
                job.check_weights()
                collection = job.collect()
                models[task], _ = job.transfer(collection, job.pretrain(collection))
            except (ConfigError, TransferError) as error:
                missing[task] = str(error)
        if not models:
            raise ConfigError("; ".join(f"{task}: {reason}" for task, reason in missing.items()))
        if last:
            tuned = copy.deepcopy(next(iter(models.values())))
            try:
                tuned.load_state_dict(torch.load(last, weights_only=True)["state_dict"])
            except RuntimeError as error:
                reason = " ".join(str(error).split())[:200]
                raise ConfigError(
                    f"{last} does not fit model={cfg.model.name} ({reason}): give the overrides of its run"
                ) from None
            models["fine-tuned"] = tuned.eval()
    robot = build.robot_factory(cfg, cfg.primitive)()
    try:
        figures.heatmaps(robot, models, build.policy(cfg), scenes, cfg.primitive.name, out, cfg.evaluate.scenes)
    finally:
        robot.close()
    return missing


def _of_run(run: Path, typed: Sequence[str]) -> list[str]:
    """What a run was typed with, but for its task and whatever is typed anew: its tool, its objects, its observations.

    Raises:
        ConfigError: The run does not say.
    """
    path = run / ".hydra" / "overrides.yaml"
    if not path.is_file():
        raise ConfigError(f"{path} is not there: --run takes the folder of a finished run")
    anew = {_key(override) for override in typed} | {"transfer", "force"}
    return [o for o in map(str, OmegaConf.load(path)) if _key(o) not in anew and _key(o).split(".")[0] != "task"]


def _key(override: str) -> str:
    return override.split("=")[0].lstrip("+~")
