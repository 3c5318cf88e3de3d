"""The schema of a run's configuration, and the checks that no type can express."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.utils import get_object
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from see2act.cache import foreign_code, given_files

LOCAL = ("name", "hydra", "paths", "logger", "seed", "force", "figures", "threads", "cells")
"""What leaves the results as they are, or has a place of its own in the run's path: not part of the hash."""
LOCAL_TRAINER = ("accelerator", "logger", "log_every_n_steps", "num_sanity_val_steps")
"""The same of the trainer's keys, with everything that starts with ``enable_``, and one device."""
HASH_LENGTH = 12


class ConfigError(ValueError):
    """A configuration that cannot run; the message is one line and names the mend."""


@dataclass
class TaskConfig:
    """A source of parameters: a vision task, or none."""

    name: str = MISSING
    label: dict[str, Any] | None = None
    """``_target_`` and arguments of a :class:`see2act.datamodules.labels.Task`; null where nothing is learned."""
    parts: list[str] = field(default_factory=list)
    """What this source can give: backbone, head."""
    weights: str | None = None
    """A file to take instead of pre-training or downloading: a vision checkpoint, or torchvision's weights."""
    off_the_shelf: dict[str, Any] | None = None
    """``_target_`` and arguments of a :class:`see2act.modules.weights.OffTheShelf`; null for tasks learned here."""
    optional: list[str] = field(default_factory=list)
    """Beginnings of keys that off-the-shelf weights lack; they start at their initialisation."""
    zero: list[str] = field(default_factory=list)
    """The same; they start at zero."""
    model: str | None = None
    """The only model that off-the-shelf weights fit."""
    class_weight: str = "none"
    """``none``, or ``balanced`` to weigh positive pixels by the inverse of their share."""


@dataclass
class TransferConfig:
    """What is copied from the vision model."""

    name: str = MISSING
    parts: list[str] = field(default_factory=list)
    finetune: bool = True


@dataclass
class PrimitiveConfig:
    """A motion primitive and the numbers that go with it."""

    name: str = MISSING
    angles: int = MISSING
    footprint: list[float] = field(default_factory=list)
    """Metres from the middle of the open tool to its ends, along the jaws and across: what needs room between the walls."""
    end_effector: dict[str, Any] = field(default_factory=dict)
    lr: float = MISSING
    """Learning rate of fine-tuning, for every arm alike; of networks that have none of their own in ``model.rates``."""
    attempts: int = MISSING
    """Fine-tuning attempts of the main job."""
    benchmark_attempts: int = MISSING
    """Of a run of the benchmark."""
    evaluate_at: list[int] = field(default_factory=list)
    turn: float = MISSING
    """Radians by which a scene may be turned about a pick that stays as good."""


@dataclass
class CollectConfig:
    """Random interaction before pre-training."""

    interactions: int = MISSING
    per_scene: int = MISSING
    seed: int = MISSING
    workers: int = MISSING
    primitive: PrimitiveConfig = field(default_factory=PrimitiveConfig)


@dataclass
class PretrainConfig:
    """Learning to see."""

    epochs: int = MISSING
    batch_size: int = MISSING
    lr: float = MISSING
    weight_decay: float = MISSING
    validation: float = MISSING
    test_scenes: int = MISSING
    seed: int = MISSING


@dataclass
class ReplayConfig:
    """Prioritized experience replay."""

    alpha: float = MISSING
    beta: float = MISSING
    floor: float = MISSING
    mirror: bool = MISSING
    turn: float = MISSING
    shift: float = MISSING
    tint: float = MISSING


@dataclass
class FinetuneConfig:
    """Learning to act."""

    attempts: int = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    backbone_lr: float = MISSING
    head_lr: float = MISSING
    weight_decay: float = MISSING
    batchnorm: str = MISSING
    averaging: float = MISSING
    logit_scale: float = MISSING
    temperature: float = MISSING
    episode_attempts: int = MISSING
    replay: ReplayConfig = field(default_factory=ReplayConfig)


@dataclass
class AttemptsConfig:
    """Attempts of a test run at most, by what it tests."""

    seen: int = MISSING
    unseen: int = MISSING


@dataclass
class EvaluateConfig:
    """Measuring success."""

    runs: int = MISSING
    at: list[int] = MISSING
    attempts: AttemptsConfig = field(default_factory=AttemptsConfig)
    scenes: str = MISSING


@dataclass
class FiguresConfig:
    """Pictures of a run."""

    scenes: int = MISSING
    """Of each split."""


@dataclass
class PathsConfig:
    """Where things are kept."""

    cache: str = MISSING


@dataclass
class Config:
    """Everything a run depends on. Groups without a class of their own are read by what they instantiate."""

    task: TaskConfig = field(default_factory=TaskConfig)
    transfer: TransferConfig = field(default_factory=TransferConfig)
    primitive: PrimitiveConfig = field(default_factory=PrimitiveConfig)
    model: dict[str, Any] = field(default_factory=dict)
    objects: dict[str, Any] = field(default_factory=dict)
    workspace: dict[str, Any] = field(default_factory=dict)
    camera: dict[str, Any] = field(default_factory=dict)
    robot: dict[str, Any] = field(default_factory=dict)
    policy: dict[str, Any] = field(default_factory=dict)
    trainer: dict[str, Any] = field(default_factory=dict)
    logger: dict[str, Any] = field(default_factory=dict)
    cells: list[str] = field(default_factory=list)
    """primitive/task/transfer of the cells of a sweep that an experiment consists of; empty: all that make sense."""
    name: str = "sweep"
    """Of the experiment."""
    labels: str = "truth"
    seed: int = 0
    precision: str = MISSING
    """``bf16`` or ``fp32``; see :func:`native_precision`."""
    threads: int = 2
    """Of torch. Sums depend on it in the last digits, as they do on the processor; neither is part of the hash."""
    force: bool = False
    collect: CollectConfig = field(default_factory=CollectConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    finetune: FinetuneConfig = field(default_factory=FinetuneConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    figures: FiguresConfig = field(default_factory=FiguresConfig)
    paths: PathsConfig = field(default_factory=PathsConfig)


def register() -> None:
    """Make the schema and the hash known to Hydra; safe to call twice."""
    ConfigStore.instance().store("schema", Config)
    OmegaConf.register_new_resolver("config_hash", lambda _root_: config_hash(_root_), replace=True)
    OmegaConf.register_new_resolver("native_precision", native_precision, replace=True)


def native_precision() -> str:
    """``bf16`` where the processor computes in bfloat16, which is several times faster there, or else ``fp32``."""
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return "fp32"
    return "bf16" if {"avx512_bf16", "amx_bf16"} & {*flags} else "fp32"


def composed(overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a run, for use without the command line: in tests, measurements, notebooks.

    Raises:
        ConfigError: A key or an option does not exist, with one line.
    """
    return composed_as_typed(overrides)


def composed_as_typed(overrides: Sequence[str], return_hydra_config: bool = False) -> DictConfig:
    """What Hydra makes of a command line, also within a program that Hydra runs.

    Raises:
        ConfigError: A key or an option does not exist, with one line.
    """
    register()
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module("see2act.conf", version_base="1.3"):
            return compose("train", [*overrides], return_hydra_config=return_hydra_config)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(one_line(error)) from None
    except ValueError as error:  # Hydra's, of a group that was given something else than the name of an option
        raise ConfigError(f"{one_line(error)}: name an option of the group, as logger=none") from None
    finally:
        GlobalHydra.instance().hydra = outer


def one_line(error: BaseException) -> str:
    """Hydra's explanation on one line, its tabs and blank lines folded."""
    cause = error.__cause__ if str(error).startswith("Error merging override") and error.__cause__ else None
    told = f"{error}: {cause}" if cause else str(error)
    for noise in ("Set the environment variable", "Config search path:", "full_key:"):
        told = told.split(noise)[0]
    text = " ".join(told.split())
    if "Could not override" in text and "To append to your config" in text:
        key = text.split("Could not override '")[1].split("'")[0]
        return f"there is no configuration key '{key}': see `python train.py --cfg job` for all of them"
    return text.replace("Available options in", "choose from the options of")


def config_hash(cfg: DictConfig) -> str:
    """Hash of everything that can change a result but the seed: the runs that differ by seed alone share it."""
    resolved: dict[str, Any] = {}
    for key in (str(key) for key in cfg if key not in LOCAL):
        value = cfg[key]
        resolved[key] = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    resolved["collect"].pop("workers")
    resolved["robot"].pop("video", None)
    resolved["trainer"] = relevant_trainer(cfg)
    return content_hash(given_files(resolved) | foreign_code(resolved))


def relevant_trainer(cfg: DictConfig) -> dict[str, Any]:
    """The trainer's keys that can change a result."""
    trainer: dict[str, Any] = OmegaConf.to_container(cfg.trainer, resolve=True)  # type: ignore[assignment]
    deciding = {k: v for k, v in trainer.items() if k not in LOCAL_TRAINER and not k.startswith("enable_")}
    devices = deciding.get("devices")
    if devices == 1 or (isinstance(devices, list) and len(devices) == 1):  # several share a batch's work, and change it
        del deciding["devices"]
    return deciding


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


def content_hash(data: object) -> str:
    """Twelve hexadecimal digits that depend on plain data only."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:HASH_LENGTH]


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
    if cfg.task.model and cfg.model.name != cfg.task.model:
        return f"task={task} has weights for model={cfg.task.model} alone, not for {cfg.model.name}: add model={cfg.task.model}"
    missing = [part for part in cfg.transfer.parts if part not in cfg.task.parts]
    if missing:
        return f"task={task} has no {' or '.join(missing)}, so transfer={transfer} is impossible: use transfer=backbone"
    return None


COUNTS = (
    "threads",
    *(f"collect.{key}" for key in ("interactions", "per_scene", "workers")),
    *(f"pretrain.{key}" for key in ("epochs", "batch_size", "test_scenes")),
    *(f"finetune.{key}" for key in ("updates", "batch_size", "episode_attempts")),
    *("evaluate.runs", "primitive.angles", "figures.scenes"),
)
"""Keys that must be at least 1."""
NOT_NEGATIVE = (
    *("pretrain.lr", "pretrain.weight_decay"),
    *(f"finetune.{key}" for key in ("attempts", "backbone_lr", "head_lr", "weight_decay", "temperature")),
    *(f"finetune.replay.{key}" for key in ("alpha", "beta", "turn", "tint")),
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
CHOICES = ("task", "transfer", "primitive", "model", "objects", "workspace", "camera", "policy")
"""Groups whose names a result has."""
WORD = r"\w+"
"""What such a name must match."""


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
    if not 0 <= cfg.finetune.averaging < 1:
        raise ConfigError(f"finetune.averaging={cfg.finetune.averaging} must be at least 0 and below 1: 0 does not average")
    if not 0 < cfg.finetune.replay.floor < math.inf:
        raise ConfigError(f"finetune.replay.floor={cfg.finetune.replay.floor} must be above 0, or some are never drawn")
    if not 0 < cfg.finetune.logit_scale < math.inf:
        raise ConfigError(f"finetune.logit_scale={cfg.finetune.logit_scale} must be above 0: 1 leaves logits as they are")


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
