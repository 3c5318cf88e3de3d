"""What a configuration must be to run, where no type of the schema can say it."""

from __future__ import annotations

import inspect
import math
import re
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from hydra.errors import HydraException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from see2act.errors import ConfigError
from see2act.experiment.config import Config, one_line
from see2act.experiment.identity import CHOICES, WORD
from see2act.robot.types import RobotError


def check_arguments(node: Any, path: str) -> None:
    """Refuse values of the wrong type, and names that do not exist, for whatever a configuration node builds.

    Schemas of their own would repeat the signatures; so the signature of each ``_target_`` is the schema.

    Raises:
        ConfigError: With the key, the value and what is expected.
    """
    if not isinstance(node, DictConfig):
        return
    for key in map(str, node):
        check_arguments(node[key], f"{path}.{key}")
    if "_target_" not in node:
        return
    parameters = inspect.signature(get_object(node._target_)).parameters
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    for name in map(str, node):
        value: Any = node[name]
        if name.startswith("_"):
            continue
        if name not in parameters:
            if open_ended:
                continue
            raise ConfigError(f"{path} has no parameter '{name}': it takes {', '.join(parameters)}")
        annotation = parameters[name].annotation
        kind = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")
        expected = SIMPLE.get(kind)
        if expected and (not isinstance(value, expected) or (isinstance(value, bool) and bool not in expected)):
            raise ConfigError(f"{path}.{name}={value} has the wrong type: it must be {kind}")


SIMPLE: dict[str, tuple[type, ...]] = {"int": (int,), "float": (float, int), "bool": (bool,), "str": (str,)}


def check_keys(cfg: DictConfig, schema: type = Config, path: str = "") -> None:
    """Refuse keys that nothing reads, which ``+key=value`` lets in.

    Args:
        cfg: A configuration, or a part of it.
        schema: The dataclass that it must be.
        path: Of the part, with a dot at its end.

    Raises:
        ConfigError: With the keys that there are.
    """
    known = get_type_hints(schema)
    for key in map(str, cfg):
        if key not in known:
            where = f" of {path[:-1]}" if path else ""
            raise ConfigError(f"there is no configuration key '{path}{key}': the keys{where} are {', '.join(known)}")
        if is_dataclass(known[key]):
            check_keys(cfg[key], known[key], f"{path}{key}.")


def illegal_cell(cfg: DictConfig) -> str | None:
    """Why a task and a transfer do not go together, with the mend; None where they do."""
    task, transfer = cfg.task.name, cfg.transfer.name
    if task == "none" and transfer != "none":
        return f"task=none has nothing to transfer, so transfer={transfer} is impossible: use transfer=none, or choose a task"
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


COUNTS = (
    "threads",
    *(f"collect.{key}" for key in ("interactions", "per_scene", "workers")),
    *(f"pretrain.{key}" for key in ("epochs", "batch_size", "test_scenes")),
    *(f"finetune.{key}" for key in ("robots", "updates", "batch_size", "episode_attempts")),
    *("evaluate.runs", "primitive.angles", "figures.scenes"),
)
"""Keys that must be at least 1."""
NOT_NEGATIVE = (
    *("pretrain.lr", "pretrain.weight_decay"),
    *(f"finetune.{key}" for key in ("attempts", "backbone_lr", "head_lr", "weight_decay", "temperature")),
    *(f"finetune.replay.{key}" for key in ("alpha", "beta", "rotation", "color_jitter")),
)
"""Keys that must be at least 0."""
PHYSICAL = ("primitive.end_effector", "collect.primitive.end_effector", "robot", "camera")
"""Where see2act's own classes have numbers that are lengths, times, forces and the like; lists are positions."""
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
        ConfigError: With one line that names the mend.
    """
    check_keys(cfg)
    if reason := illegal_cell(cfg):
        raise ConfigError(reason)
    _check_words(cfg)
    _check_numbers(cfg)
    for path in PHYSICAL:
        _check_physical(OmegaConf.select(cfg, path), path)
    _check_model(cfg)
    _check_footprint(cfg)
    _check_lengths(cfg)
    _check_vision(cfg)


def _check_words(cfg: DictConfig) -> None:
    _choice("labels", cfg.labels, ("truth", "vision"))
    _choice("precision", cfg.precision, ("bf16", "fp32"))
    for key, mend in OVERRULED.items():
        value = cfg.trainer.get(key)
        if value is not None and value is not False and value != -1:  # Lightning's own words for none
            raise ConfigError(f"trainer.{key} has no place here: {mend}")
    for group in CHOICES:
        name = OmegaConf.select(cfg, f"{group}.name")
        if not re.fullmatch(WORD, str(name or "")):
            raise ConfigError(f"{group}.name={name} is no word: use letters, digits and _")
    for cell in cfg.cells:
        if not re.fullmatch(f"{WORD}/{WORD}/{WORD}", cell):
            raise ConfigError(f"cells has '{cell}': each must be primitive/task/transfer, as suction/edge/full")
    _choice("finetune.batchnorm", cfg.finetune.batchnorm, ("frozen", "batch"))
    _choice("evaluate.scenes", cfg.evaluate.scenes, ("evaluate", "develop"))
    _choice("task.class_weight", cfg.task.class_weight, ("none", "balanced"))


def _check_numbers(cfg: DictConfig) -> None:
    for key in COUNTS:
        _at_least(key, OmegaConf.select(cfg, key), 1)
    for key in ("model.width", "model.anchors"):
        if isinstance(value := OmegaConf.select(cfg, key), int):  # if it is there; another type is refused with the others
            _at_least(key, value, 1)
    for key in NOT_NEGATIVE:
        _at_least(key, OmegaConf.select(cfg, key), 0)
    for split in ("seen", "unseen"):
        _at_least(f"evaluate.attempts.{split}", cfg.evaluate.attempts.get(split, 0), 1)
    for step in cfg.evaluate.at:
        _at_least("evaluate.at", step, 0)
    _check_robots(cfg)
    if not 0 <= cfg.finetune.averaging < 1:
        raise ConfigError(f"finetune.averaging={cfg.finetune.averaging} must be at least 0 and below 1: 0 does not average")
    if not 0 < cfg.finetune.replay.floor < math.inf:
        raise ConfigError(f"finetune.replay.floor={cfg.finetune.replay.floor} must be above 0, or some are never drawn")
    if not 0 < cfg.finetune.logit_scale < math.inf:
        raise ConfigError(f"finetune.logit_scale={cfg.finetune.logit_scale} must be above 0: 1 leaves logits as they are")


def _check_robots(cfg: DictConfig) -> None:
    """Robots side by side all try before anything else happens."""
    robots, attempts = cfg.finetune.robots, cfg.finetune.attempts
    steps = [step for step in cfg.evaluate.at if step <= attempts]
    if attempts % robots or any(step % robots for step in steps):
        at = sorted({-(-step // robots) * robots for step in steps})
        raise ConfigError(
            f"finetune.robots={robots} make as many attempts at once, so finetune.attempts={attempts} and "
            f"evaluate.at={list(cfg.evaluate.at)} must be multiples of it: "
            f"finetune.attempts={-(-attempts // robots) * robots} 'evaluate.at={at}'"
        )


def _check_physical(node: Any, path: str) -> None:
    if not isinstance(node, DictConfig):
        return
    ours = str(node.get("_target_", "")).startswith("see2act.")
    for key in (str(key) for key in node if not OmegaConf.is_missing(node, key)):
        value: Any = node[key]
        _check_physical(value, f"{path}.{key}")
        negative = isinstance(value, int | float) and value < 0 and key != "depth"  # a pinch above the surface it aims at
        if ours and (negative or (isinstance(value, float) and math.isnan(value))):
            raise ConfigError(f"{path}.{key}={value} is no length, force or time: it must be at least 0")


def _check_model(cfg: DictConfig) -> None:
    """Refuse keys of the model that nothing reads: ``+model.widht=64`` would train another one than is meant."""
    interpolations = re.findall(r"\$\{.*?\}", OmegaConf.to_yaml(cfg))
    read = {"name", "rates", "network", *cfg.model.get("network", {}), *re.findall(r"\w+", " ".join(interpolations))}
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
    if cfg.task.weights and not (cfg.task.label or cfg.task.off_the_shelf):
        raise ConfigError(f"task={cfg.task.name} takes no task.weights: choose the task that the weights were trained on")
    if cfg.task.weights and not Path(cfg.task.weights).is_file():
        raise ConfigError(f"task.weights={cfg.task.weights} is no file: give the path of a run's checkpoints/vision.ckpt")
    floor = OmegaConf.select(cfg, "robot.bin.floor")
    if cfg.labels == "vision" and cfg.task.label and floor not in (None, "plain"):
        raise ConfigError(
            f"labels=vision subtracts one empty bin, and with robot.bin.floor={floor} each scene has another: use labels=truth"
        )
    if not 0 < cfg.pretrain.validation < 1:
        raise ConfigError(f"pretrain.validation={cfg.pretrain.validation} must lie between 0 and 1: it is a share")
    train = cfg.collect.interactions - max(1, round(cfg.pretrain.validation * cfg.collect.interactions))
    if cfg.task.label and train < cfg.pretrain.batch_size:
        raise ConfigError(
            f"collect.interactions={cfg.collect.interactions} leaves {train} observations for training, less than one batch "
            f"of {cfg.pretrain.batch_size}: collect more, or lower pretrain.batch_size"
        )


def _choice(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"{key}={value} is unknown: choose one of {', '.join(allowed)}")


def _at_least(key: str, value: float, least: float) -> None:
    if not math.isfinite(value):
        raise ConfigError(f"{key}={value} is no number: it must be at least {least}")
    if value < least:
        raise ConfigError(f"{key}={value} is too small: it must be at least {least}")


def check_parts(cfg: DictConfig) -> None:
    """Build what is cheap to build, so that wrong parameters of objects, camera or workspace show now.

    Raises:
        ConfigError: With one line.
    """
    import torch  # takes seconds, which --help should not

    from see2act.experiment import build

    try:
        for group in ("policy", "model", "workspace", "camera", "objects", "robot", "task", "primitive"):
            check_arguments(cfg[group], group)
        build.robot_factory(cfg, cfg.primitive)().close()
        build.policy(cfg)
        with torch.device("meta"):  # parameters without values: nothing is drawn from anybody's generator
            instantiate(cfg.model.network)
    except (RobotError, HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error, HydraException) and error.__cause__ else error
        raise ConfigError(one_line(cause)) from None


def check_run(cfg: DictConfig) -> None:
    """The same, and what a run alone needs; apart, since Lightning takes seconds that a robot by itself need not wait for.

    Raises:
        ConfigError: With one line.
    """
    from see2act.experiment import build

    check_parts(cfg)
    for group in ("trainer", "logger", "collect.primitive"):
        check_arguments(OmegaConf.select(cfg, group), group)
    learns_to_see = cfg.task.label and not cfg.task.weights
    if learns_to_see:
        _check_shape(cfg)
    _check_trainer(cfg, {} if learns_to_see else build.one_device(cfg))


def _check_shape(cfg: DictConfig) -> None:
    """Run a heightmap through the network: a vision model learns from whole ones, of whatever size the workspace has."""
    import torch

    rows, cols = instantiate(cfg.workspace).shape
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        network = instantiate(cfg.model.network).eval()
        try:
            given = tuple(network(torch.zeros(1, 4, rows, cols)).shape)
        except (RuntimeError, ValueError, AssertionError) as error:
            raise ConfigError(
                f"model={cfg.model.name} takes no heightmap of {rows} x {cols} pixels: {one_line(error)}"
            ) from None
    if given != (1, 1, rows, cols):
        raise ConfigError(
            f"model={cfg.model.name} gives {given} for a heightmap of {rows} x {cols} pixels, not (1, 1, {rows}, {cols}): "
            f"its head must give a logit for every pixel of an input whose sides are multiples of its stride, {network.stride}"
        )


def _check_trainer(cfg: DictConfig, here: dict[str, Any]) -> None:
    """Build one, since what it asks for need not be in this machine."""
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    from see2act.experiment.quiet import quiet

    quiet()
    try:
        instantiate(cfg.trainer)(**here)
    except (HydraException, MisconfigurationException, ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"this machine has no such trainer: {one_line(error)}") from None
