"""The schema of a run's configuration, and how it is composed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import AfterValidator, ConfigDict, Field

from see2act.errors import ConfigError
from see2act.experiment.attended import attended
from see2act.experiment.identity import WORD, config_hash
from see2act.experiment.precision import fastest_precision

NO_OTHER_KEYS = ConfigDict(extra="forbid")
MOST = 10**6
"""Of anything that is counted: more would take years, or all memory."""
Count = Annotated[int, Field(ge=1, le=MOST)]
NotNegativeInt = Annotated[int, Field(ge=0, le=MOST)]
Processes = Annotated[int, Field(ge=1, le=1024)]
"""Or threads."""
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Factor = Annotated[float, Field(ge=1, allow_inf_nan=False)]


def OneOf(*words: str) -> AfterValidator:
    """Annotation of a string that must be one of some words. (OmegaConf knows no ``Literal``.)"""

    def check(word: str) -> str:
        if word not in words:
            raise ValueError(f"choose one of {', '.join(words)}")
        return word

    return AfterValidator(check)


def Like(pattern: str, advice: str) -> AfterValidator:
    """Annotation of a string that must match a pattern."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ValueError(advice)
        return text

    return AfterValidator(check)


Word = Annotated[str, Like(WORD, "use letters, digits and _")]
Condition = Annotated[str, Like(f"{WORD}/{WORD}/{WORD}", "each must be primitive/task/transfer, as suction/edge/full")]


@dataclass
class TaskConfig:
    """A source of parameters: a vision task, or none."""

    __pydantic_config__ = NO_OTHER_KEYS
    name: Word = MISSING
    label: dict[str, Any] | None = None
    """``_target_`` and arguments of a :class:`see2act.datamodules.labels.Task`; null where nothing is learned."""
    parts: list[str] = field(default_factory=list)
    """What this source can give: backbone, head."""
    weights: str | None = None
    """A file to take instead of pre-training or downloading: a vision checkpoint, or torchvision's weights. Of
    ``task=affordance`` the folder of a finished run, or its ``checkpoints/model.safetensors``."""
    affordance: bool = False
    """Whether the weights are those of an affordance model, which has learned to pick and not only to see."""
    off_the_shelf: dict[str, Any] | None = None
    """By model ``_target_`` and arguments of a :class:`see2act.modules.weights.OffTheShelf`; null for tasks learned here."""
    optional: list[str] = field(default_factory=list)
    """Beginnings of keys that off-the-shelf weights lack; they start at their initialisation."""
    zero: list[str] = field(default_factory=list)
    """The same; they start at zero."""
    class_weight: Annotated[str, OneOf("none", "balanced")] = "none"
    """``none``, or ``balanced`` to weigh positive pixels by the inverse of their share."""


@dataclass
class TransferConfig:
    """What is copied from the vision model."""

    __pydantic_config__ = NO_OTHER_KEYS
    name: Word = MISSING
    parts: list[str] = field(default_factory=list)
    finetune: bool = True


@dataclass
class PrimitiveConfig:
    """A motion primitive and the numbers that go with it."""

    __pydantic_config__ = NO_OTHER_KEYS
    name: Word = MISSING
    angles: Annotated[int, Field(ge=1, le=360)] = MISSING
    footprint: list[float] = field(default_factory=list)
    """Metres from the middle of the open tool to its ends, along the jaws and across: what needs room between the walls."""
    end_effector: dict[str, Any] = field(default_factory=dict)
    lr: NotNegative = MISSING
    """Learning rate of fine-tuning, for networks without rates of their own in ``model.rates``."""
    lr_warmup: NotNegativeInt = MISSING
    """Learning steps over which the rates of fine-tuning rise."""
    attempts: NotNegativeInt = MISSING
    """Fine-tuning attempts of the main job."""
    short_attempts: NotNegativeInt = MISSING
    """Of a comparison with off-the-shelf weights: the paper's ten minutes of suction, its hour of grasping."""
    benchmark_attempts: NotNegativeInt = MISSING
    """Of a run of the benchmark."""
    evaluate_at: list[NotNegativeInt] = field(default_factory=list)
    benchmark_evaluate_at: list[NotNegativeInt] = field(default_factory=list)
    avoided_radius: NotNegative = MISSING
    """Metres around a failed pick that ``policy=suppress`` avoids."""
    avoided_until_success: bool = MISSING
    """Whether it forgets failed picks when a pick succeeds."""
    rotation_tolerance: NotNegative = MISSING
    """Radians by which a scene may be turned about a pick that stays as good."""


@dataclass
class CollectConfig:
    """Random interaction before pre-training."""

    __pydantic_config__ = NO_OTHER_KEYS
    interactions: Count = MISSING
    per_scene: Count = MISSING
    seed: int = MISSING
    workers: Processes = MISSING
    folder: str | None = MISSING
    """Where observations of a robot are kept whose bin a person fills, a file each. A later run takes the first of them, and
    adds what it needs beyond; no new version discards them. null for a simulated robot, whose observations are in the cache."""
    primitive: PrimitiveConfig = field(default_factory=PrimitiveConfig)


@dataclass
class PretrainConfig:
    """Learning to see."""

    __pydantic_config__ = NO_OTHER_KEYS
    epochs: Count = MISSING
    batch_size: Count = MISSING
    lr: NotNegative = MISSING
    weight_decay: NotNegative = MISSING
    validation: Annotated[float, Field(gt=0, lt=1)] = MISSING
    test_scenes: Count = MISSING
    seed: int = MISSING


@dataclass
class ReplayConfig:
    """Prioritized experience replay."""

    __pydantic_config__ = NO_OTHER_KEYS
    alpha: Annotated[float, Field(ge=0, le=10)] = MISSING
    beta: Annotated[float, Field(ge=0, le=10)] = MISSING
    floor: Positive = MISSING
    mirror: bool = MISSING
    rotation: NotNegative = MISSING
    shift: NotNegative = MISSING
    color_jitter: Annotated[float, Field(ge=0, le=1)] = MISSING


@dataclass
class FinetuneConfig:
    """Learning to act."""

    __pydantic_config__ = NO_OTHER_KEYS
    attempts: NotNegativeInt = MISSING
    robots: Processes = MISSING
    updates: Count = MISSING
    batch_size: Count = MISSING
    backbone_lr: NotNegative = MISSING
    head_lr: NotNegative = MISSING
    lr_warmup: NotNegativeInt = MISSING
    weight_decay: NotNegative = MISSING
    batchnorm: Annotated[str, OneOf("frozen", "batch")] = MISSING
    averaging: Annotated[float, Field(ge=0, lt=1)] = MISSING
    averaging_warmup: NotNegativeInt = MISSING
    logit_scale: Positive = MISSING
    temperature: NotNegative = MISSING
    widening: Factor = MISSING
    episode_attempts: Count = MISSING
    replay: ReplayConfig = field(default_factory=ReplayConfig)


@dataclass
class AttemptsConfig:
    """Attempts of a test run at most, by what it tests."""

    __pydantic_config__ = NO_OTHER_KEYS
    seen: Count = MISSING
    unseen: Count = MISSING


@dataclass
class EvaluateConfig:
    """Measuring success."""

    __pydantic_config__ = NO_OTHER_KEYS
    runs: Count = MISSING
    at: list[NotNegativeInt] = MISSING
    """Fine-tuning attempts after which the model is evaluated, besides the last one. A simulated robot evaluates before the
    first one, too; one whose bin a person fills does so if 0 is among these."""
    argmax: bool = MISSING
    """Whether the last model is also evaluated with the plain argmax policy."""
    attempts: AttemptsConfig = field(default_factory=AttemptsConfig)
    scenes: Annotated[str, OneOf("evaluate", "develop")] = MISSING


@dataclass
class FiguresConfig:
    """Pictures of a run."""

    __pydantic_config__ = NO_OTHER_KEYS
    scenes: Count = MISSING
    """Of each split."""


@dataclass
class PathsConfig:
    """Where things are kept."""

    __pydantic_config__ = NO_OTHER_KEYS
    cache: str = MISSING


@dataclass
class Config:
    """Everything a run depends on. Groups without a class of their own are read by what they instantiate."""

    __pydantic_config__ = NO_OTHER_KEYS
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
    conditions: list[Condition] = field(default_factory=list)
    """primitive/task/transfer of each condition of an experiment; empty: all that make sense."""
    name: str = "sweep"
    """Of the experiment."""
    labels: Annotated[str, OneOf("truth", "vision")] = "truth"
    seed: int = 0
    precision: Annotated[str, OneOf("bf16", "fp32")] = MISSING
    """``bf16`` or ``fp32``; see :mod:`see2act.experiment.precision`."""
    threads: Processes = 2
    """Of torch. Sums depend on it in the last digits, as they do on the processor; neither is part of the hash."""
    force: bool = False
    collect: CollectConfig = field(default_factory=CollectConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    finetune: FinetuneConfig = field(default_factory=FinetuneConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    figures: FiguresConfig = field(default_factory=FiguresConfig)
    paths: PathsConfig = field(default_factory=PathsConfig)


def register() -> None:
    """Make the schema and the resolvers of ``conf/`` known to Hydra; safe to call twice."""
    ConfigStore.instance().store("schema", Config)
    OmegaConf.register_new_resolver("config_hash", lambda _root_: config_hash(_root_), replace=True)
    OmegaConf.register_new_resolver("if_attended", _if_attended, replace=True)
    OmegaConf.register_new_resolver("fastest_precision", fastest_precision, replace=True)


def _if_attended(value: Any, otherwise: Any, *, _root_: DictConfig) -> Any:
    """A default that is another one for a robot whose bin a person fills."""
    return value if attended(_root_) else otherwise


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
    except HYDRA_FAILS as error:
        typed = " ".join(filter(_fails_alone, overrides)) or "what is typed"
        raise ConfigError(
            f"{typed} cannot be composed ({one_line(error)}): of a group name an option, as logger=none"
        ) from None
    finally:
        GlobalHydra.instance().hydra = outer


HYDRA_FAILS = (ValueError, TypeError, AttributeError, LookupError, RecursionError)
"""What Hydra raises without an explanation if a group is given something else than an option's name, as a list."""


def _fails_alone(override: str) -> bool:
    """Whether Hydra fails so on this override without the others."""
    try:
        with initialize_config_module("see2act.conf", version_base="1.3"):
            compose("train", [override])
    except (HydraException, OmegaConfBaseException):
        return False
    except HYDRA_FAILS:
        return True
    finally:
        GlobalHydra.instance().clear()
    return False


def one_line(error: BaseException) -> str:
    """Hydra's explanation on one line, its tabs and blank lines folded."""
    cause = error.__cause__ if str(error).startswith("Error merging override") and error.__cause__ else None
    told = f"{error}: {cause}" if cause else str(error)
    if (key := getattr(error, "full_key", None)) and key not in told.split("full_key:")[0]:
        told = f"{key}: {told}"
    for noise in ("Set the environment variable", "Config search path:", "full_key:"):
        told = told.split(noise)[0]
    text = " ".join(told.split())
    if "Could not override" in text and "To append to your config" in text:
        key = text.split("Could not override '")[1].split("'")[0]
        return f"there is no configuration key '{key}': see `python train.py --cfg job` for all of them"
    return text.replace("Available options in", "choose from the options of")
