"""The paper's figure of heatmaps: the same observations through every source model, and through a fine-tuned one.

Collected data and vision models come from the cache, or are made now as train.py would make them. Source models whose
weights are not here are left out and named.
"""

from __future__ import annotations

import argparse
import copy
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omegaconf import OmegaConf
from yaml import YAMLError

from see2act.commands import user_errors_end_the_program
from see2act.errors import ConfigError, TransferError
from see2act.experiment.checkpoints import load_checkpoint
from see2act.experiment.checks import check_parts, validate
from see2act.experiment.config import composed
from see2act.experiment.identity import WORD
from see2act.experiment.preflight import leave_unmeasured
from see2act.files import writable

TASKS = ("none", "imagenet", "edge", "corner", "center", "foreground", "normal", "coco")
TRANSFERS = {"none": "none", "imagenet": "backbone"}
"""What is copied for the figure; everything else is copied whole."""
MOST = 50
"""Scenes of each split that a figure has room for."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, metavar="DIR", help="a finished run whose fine-tuned model is shown last")
    parser.add_argument("--tasks", default=",".join(TASKS), metavar="TASK,TASK", help="default: %(default)s")
    parser.add_argument("--scenes", type=int, default=1, metavar="N", help="of each split (default 1)")
    parser.add_argument("--out", type=Path, default=Path("heatmaps"), metavar="DIR", help="default: heatmaps/")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="configuration, as for train.py")
    args = parser.parse_intermixed_args(arguments)
    with user_errors_end_the_program():
        missing = draw(args.overrides, args.tasks.split(","), args.run, args.scenes, args.out)
    for task, reason in missing.items():
        print(f"left out: {task}: {reason}")
    print(args.out / "heatmaps.png")


def draw(overrides: Sequence[str], tasks: Sequence[str], run: Path | None, scenes: int, out: Path) -> dict[str, str]:
    """Make the figure in ``out``; what had to be left out, with the reason.

    Raises:
        ConfigError: The configuration is impossible, a task is unknown, or the run's model is another one.
    """
    _check(overrides, tasks, scenes, out)
    import torch  # torch and lightning take seconds, which --help should not

    from see2act.experiment import build, figures
    from see2act.experiment.stages.collect import collected
    from see2act.experiment.stages.pretrain import vision_model
    from see2act.experiment.stages.transfer import affordance_model, check_weights

    models, missing = {}, {}
    last = run / "checkpoints" / "affordance.ckpt" if run else None
    if run and last and not last.is_file():
        raise ConfigError(f"{last} is not there: --run takes the folder of a finished run")
    learned = load_checkpoint(last, ("state_dict",))["state_dict"] if last else None
    overrides = [*(_of_run(run, overrides) if run else ()), *overrides]
    check_parts(composed([*overrides, "task=none", "transfer=none"]))
    configs = {task: composed([*overrides, f"task={task}", f"transfer={TRANSFERS.get(task, 'full')}"]) for task in tasks}
    with TemporaryDirectory() as scratch:
        for task, cfg in configs.items():
            torch.set_num_threads(cfg.threads)
            make_trainer = partial(build.trainer, cfg, Path(scratch), None)
            try:
                checked = copy.deepcopy(cfg)
                leave_unmeasured(checked)
                validate(checked)
                check_weights(cfg)
                collection = collected(cfg)
                models[task], _ = affordance_model(cfg, collection, vision_model(cfg, collection, make_trainer))
            except (ConfigError, TransferError) as error:
                missing[task] = str(error)
        if not models:
            raise ConfigError("; ".join(f"{task}: {reason}" for task, reason in missing.items()))
        if learned is not None:
            tuned = copy.deepcopy(next(iter(models.values())))
            try:
                tuned.load_state_dict(learned)
            except RuntimeError as error:
                reason = " ".join(str(error).split())[:200]
                raise ConfigError(
                    f"{last} does not fit model={cfg.model.name} ({reason}): give the overrides of its run"
                ) from None
            models["fine-tuned"] = tuned.eval()
    robot = build.robot_factory(cfg, cfg.primitive)()
    try:
        chooser = list(models.values())[-1]
        made = figures.first_attempts(robot, chooser.affordances, build.policy(cfg), scenes, cfg.evaluate.scenes)
        figures.heatmaps(made, models, robot, cfg.primitive.name, out)
    finally:
        robot.close()
    return missing


def _check(overrides: Sequence[str], tasks: Sequence[str], scenes: int, out: Path) -> None:
    for override in overrides:
        if _key(override) in ("task", "transfer"):
            raise ConfigError(f"{override} has no effect here: use --tasks {TASKS[2]},{TASKS[3]}")
    if not all(re.fullmatch(WORD, task) for task in tasks):
        raise ConfigError(f"--tasks {','.join(tasks)} is no list of tasks: give names, as {TASKS[2]},{TASKS[3]}")
    if not 1 <= scenes <= MOST:
        raise ConfigError(f"--scenes {scenes} is too {'small' if scenes < 1 else 'large'}: it must be from 1 to {MOST}")
    if not writable(out):
        raise ConfigError(f"--out {out} cannot be written: give a folder that you may write to")


def _of_run(run: Path, typed: Sequence[str]) -> list[str]:
    """What a run was typed with, but for its task and whatever is typed again: its tool, its objects, its observations.

    Raises:
        ConfigError: The run does not say.
    """
    path = run / ".hydra" / "overrides.yaml"
    if not path.is_file():
        raise ConfigError(f"{path} is not there: --run takes the folder of a finished run")
    again = {_key(override) for override in typed} | {"transfer", "force"}
    of_run: Any = _yaml(path)
    if not isinstance(of_run, list) or not all(isinstance(override, str) for override in of_run):
        raise _unreadable(path, "it is no list of overrides")
    searched = [] if "hydra.searchpath" in again else _searched(run)  # Hydra heeds the first of two
    return [*searched, *(o for o in of_run if _key(o) not in again and _key(o).split(".")[0] != "task")]


def _searched(run: Path) -> list[str]:
    """Where a run found configuration of its user's, which is not among its overrides but in Hydra's own file."""
    path = run / ".hydra" / "hydra.yaml"
    kept: Any = _yaml(path) if path.is_file() else {}
    try:
        places = kept["hydra"]["searchpath"] if kept else []
    except (KeyError, TypeError):
        raise _unreadable(path, "it has no hydra.searchpath") from None
    return [f"hydra.searchpath=[{','.join(repr(place) for place in places)}]"] if places else []


def _yaml(path: Path) -> Any:
    """What Hydra wrote.

    Raises:
        ConfigError: It is no YAML.
    """
    try:
        return OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, RecursionError, YAMLError) as error:
        raise _unreadable(path, " ".join(str(error).split())[:160]) from None


def _unreadable(path: Path, reason: str) -> ConfigError:
    return ConfigError(f"{path} cannot be read ({reason}): --run takes the folder of a finished run")


def _key(override: str) -> str:
    return override.split("=")[0].lstrip("+~")
