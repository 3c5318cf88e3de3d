"""What a configuration must be to run, where no type of the schema can say it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from see2act.errors import ConfigError
from see2act.experiment.annotations import check_arguments, check_builds, check_schema
from see2act.experiment.attended import attended
from see2act.experiment.config import one_line
from see2act.experiment.identity import CHOICES, WORD
from see2act.robot.types import RobotError

GIVEN = {"policy": ("pixel", "footprint"), "robot": ("workspace", "camera", "objects", "end_effector")}
"""Arguments of a group that come from elsewhere in the configuration."""
MOST_PARAMETERS = 10**9
"""Of a network: four gigabytes, and several times as much while it learns."""


def impossible_condition(cfg: DictConfig) -> str | None:
    """Why a task and a transfer do not go together, and what to do; None where they do."""
    task, transfer = cfg.task.name, cfg.transfer.name
    if task == "none" and transfer != "none":
        return f"task=none has nothing to transfer, so transfer={transfer} is impossible: use transfer=none, or choose a task"
    if cfg.task.affordance and not cfg.task.weights:
        return f"task={task} starts from a run: name its folder with task.weights="
    if transfer == "none" and task != "none":
        return (
            f"transfer=none ignores task={task}: use task=none transfer=none for the baseline, or transfer=backbone|full|fixed"
        )
    if cfg.task.off_the_shelf and cfg.model.name not in cfg.task.off_the_shelf:
        fitting = " or ".join(f"model={name}" for name in cfg.task.off_the_shelf)
        return f"task={task} has no weights for model={cfg.model.name}: add {fitting}"
    missing = [part for part in cfg.transfer.parts if part not in cfg.task.parts]
    if missing:
        return f"task={task} has no {' or '.join(missing)}, so transfer={transfer} is impossible: use transfer=backbone"
    return None


LOOPS = "use pretrain.epochs and finetune.attempts"
OVERRULED = {
    "precision": "use precision=bf16 or precision=fp32",
    **dict.fromkeys(("max_epochs", "max_steps", "max_time", "fast_dev_run", "overfit_batches"), LOOPS),
    **dict.fromkeys(("limit_train_batches", "limit_val_batches", "val_check_interval", "check_val_every_n_epoch"), LOOPS),
    "callbacks": "a run has its own",
    "logger": "use logger=",
    "default_root_dir": "use hydra.run.dir=",
}
"""The trainer's keys that a run sets itself or that would end its loops, and what to type instead."""


def validate(cfg: DictConfig) -> None:
    """Refuse what cannot run, before any work.

    Raises:
        ConfigError: With one line that says what to do.
    """
    check_schema(cfg)
    if reason := impossible_condition(cfg):
        raise ConfigError(reason)
    _check_trainer_keys(cfg)
    _check_names(cfg)
    _check_robots(cfg)
    _check_model(cfg)
    check_arguments(cfg.workspace, "workspace")  # which the next two compute with
    _check_footprint(cfg)
    _check_lengths(cfg)
    _check_vision(cfg)


def _check_trainer_keys(cfg: DictConfig) -> None:
    for key, fix in OVERRULED.items():
        value = cfg.trainer.get(key)
        if value is not None and value is not False and value != -1:  # Lightning's own words for none
            raise ConfigError(f"trainer.{key} has no place here: {fix}")


def _check_names(cfg: DictConfig) -> None:
    """Names of choices become parts of paths."""
    for group in CHOICES:
        name = OmegaConf.select(cfg, f"{group}.name")
        if not re.fullmatch(WORD, str(name or "")):
            raise ConfigError(f"{group}.name={name} is no word: use letters, digits and _")


def _check_robots(cfg: DictConfig) -> None:
    """Robots side by side all try before anything else happens."""
    robots, attempts = cfg.finetune.robots, cfg.finetune.attempts
    if attended(cfg):
        _check_real(cfg)
    elif cfg.collect.folder is not None:
        raise ConfigError(
            f"collect.folder={cfg.collect.folder} is for a robot whose bin a person fills: leave it out, since observations of "
            "a simulated one are in the cache"
        )
    steps = [step for step in cfg.evaluate.at if step <= attempts]
    if attempts % robots or any(step % robots for step in steps):
        at = sorted({-(-step // robots) * robots for step in steps})
        raise ConfigError(
            f"finetune.robots={robots} make as many attempts at once, so finetune.attempts={attempts} and "
            f"evaluate.at={list(cfg.evaluate.at)} must be multiples of it: "
            f"finetune.attempts={-(-attempts // robots) * robots} 'evaluate.at={at}'"
        )


def _check_real(cfg: DictConfig) -> None:
    """What a robot that is not simulated cannot do."""
    for key, value, fix in (
        ("finetune.robots", 1, "one robot has one bin"),
        ("labels", "vision", "nobody knows the truth about a real bin"),
    ):
        if OmegaConf.select(cfg, key) != value:
            raise ConfigError(f"robot=ur5_real needs {key}={value}: {fix}")
    if not cfg.collect.folder:
        raise ConfigError("collect.folder names no folder: leave it out, or name one that keeps the observations")


def _check_model(cfg: DictConfig) -> None:
    """Refuse keys of the model that nothing reads: ``+model.widht=64`` would train another one than is meant."""
    if not OmegaConf.is_dict(cfg.model.get("network")):
        raise ConfigError(f"model.network={cfg.model.get('network')} builds no network: choose an option of conf/model")
    interpolations = re.findall(r"\$\{.*?\}", OmegaConf.to_yaml(cfg))
    read = {"name", "rates", "network", *cfg.model.network, *re.findall(r"\w+", " ".join(interpolations))}
    if unread := [str(key) for key in cfg.model if key not in read]:
        known = ", ".join(str(key) for key in cfg.model if key in read)
        raise ConfigError(f"model.{unread[0]} is read by nothing: model={cfg.model.name} has {known}")


def _check_footprint(cfg: DictConfig) -> None:
    footprint = cfg.primitive.footprint
    most = (min(cfg.workspace.width, cfg.workspace.length) / 2 - cfg.workspace.pixel) / math.sqrt(2)
    if len(footprint) != 2 or not all(0 <= side < most for side in footprint):
        raise ConfigError(
            f"primitive.footprint={list(footprint)} leaves nothing to pick from: it must be [along, across] in metres, each "
            f"between 0 and {most:.3f}"
        )


def _check_lengths(cfg: DictConfig) -> None:
    most = min(cfg.workspace.width, cfg.workspace.length) / 2
    for key in ("policy.radius", "policy.changed_radius", "finetune.replay.shift"):
        value = OmegaConf.select(cfg, key)
        if isinstance(value, int | float) and not 0 <= value < most:  # another type is refused with the others
            raise ConfigError(f"{key}={value} is no length within the bin: it must be in metres, from 0 to below {most:g}")


def _check_vision(cfg: DictConfig) -> None:
    if cfg.task.weights and not (cfg.task.label or cfg.task.off_the_shelf or cfg.task.affordance):
        raise ConfigError(f"task={cfg.task.name} takes no task.weights: choose the task that the weights were trained on")
    if cfg.transfer.parts and not (cfg.task.label or cfg.task.off_the_shelf or cfg.task.affordance):
        raise ConfigError(
            f"task={cfg.task.name} has neither labels nor weights, so nothing can be copied: give it a task.label"
        )
    if cfg.task.weights and not cfg.task.affordance and not Path(cfg.task.weights).is_file():
        kind = "weights of that network" if cfg.task.off_the_shelf else "a run's checkpoints/vision.ckpt"
        if Path(cfg.task.weights).is_dir():
            kind += ", or type task=affordance to start from the affordance model of the run in this folder"
        raise ConfigError(f"task.weights={cfg.task.weights} is no file: give the path of {kind}")
    floor = OmegaConf.select(cfg, "robot.bin.floor")
    if cfg.labels == "vision" and cfg.task.label and floor not in (None, "plain"):
        raise ConfigError(
            f"labels=vision subtracts one empty bin, and with robot.bin.floor={floor} each scene has another: use labels=truth"
        )
    train = cfg.collect.interactions - max(1, round(cfg.pretrain.validation * cfg.collect.interactions))
    if cfg.task.label and train < cfg.pretrain.batch_size:
        raise ConfigError(
            f"collect.interactions={cfg.collect.interactions} leaves {train} observations for training, less than one batch "
            f"of {cfg.pretrain.batch_size}: collect more, or lower pretrain.batch_size"
        )


def check_parts(cfg: DictConfig) -> None:
    """Build what is cheap to build, so that wrong parameters of objects, camera or workspace show now.

    Raises:
        ConfigError: With one line.
    """
    import torch  # takes seconds, which --help should not

    from see2act.experiment import build

    try:
        for group in ("policy", "model", "workspace", "camera", "objects", "robot", "task", "primitive"):
            check_arguments(cfg[group], group, GIVEN.get(group, ()))
        for part in _built(cfg):
            check_builds(OmegaConf.select(cfg, part), part)
        build.robot_factory(cfg, cfg.primitive)().close()
        build.policy(cfg)
        with torch.device("meta"):  # parameters without values: nothing is drawn from anybody's generator
            parameters = sum(parameter.numel() for parameter in instantiate(cfg.model.network).parameters())
        if parameters > MOST_PARAMETERS:
            sizes = ", ".join(f"model.{key}={value}" for key, value in cfg.model.items() if not OmegaConf.is_config(value))
            raise ConfigError(f"{sizes} makes {parameters:.0e} parameters, more than {MOST_PARAMETERS:.0e}: make it smaller")
    except (RobotError, HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error, HydraException) and error.__cause__ else error
        raise ConfigError(one_line(cause)) from None


def _built(cfg: DictConfig) -> Iterator[str]:
    """Keys of what a run builds, whatever it does."""
    yield from ("policy", "model.network", "workspace", "camera", "objects", "robot", "primitive.end_effector")
    if cfg.task.label:
        yield "task.label"
    if cfg.task.off_the_shelf:
        yield f"task.off_the_shelf.{cfg.model.name}"


def check_run(cfg: DictConfig) -> None:
    """The same, and what a run alone needs; apart, since Lightning takes seconds that a robot by itself need not wait for.

    Raises:
        ConfigError: With one line.
    """
    check_parts(cfg)
    if cfg.robot.get("dry_run"):
        raise ConfigError("robot.dry_run=true carries no pick through, so a run would try for ever: leave it to demo.py")

    from see2act.experiment import build
    from see2act.experiment.tries import try_collector, try_labels, try_shape, try_trainer

    for group in ("trainer", "logger"):
        check_arguments(cfg[group], group, partial=True)
    check_arguments(cfg.collect.primitive, "collect.primitive")
    for part in ("trainer", *(["logger"] if cfg.logger else []), "collect.primitive.end_effector"):
        check_builds(OmegaConf.select(cfg, part), part)
    if build.needs_observations(cfg):
        if attended(cfg):
            build.observations(cfg)
        else:
            try_collector(cfg)
    learns_to_see = cfg.task.label and not cfg.task.weights
    if learns_to_see:
        try_shape(cfg)
        try_labels(cfg)
    try_trainer(cfg, {} if learns_to_see else build.one_device(cfg))
