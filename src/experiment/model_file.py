"""A fine-tuned model in one small file, with everything that is needed to pick with it elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import get_class, instantiate
from jaxtyping import Float, UInt8
from omegaconf import DictConfig, OmegaConf
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from safetensors.torch import save as serialized
from torch import Tensor

from see2act.errors import UserError
from see2act.experiment.identity import MODEL, WORD, config_hash, deciding_robot
from see2act.files import replacing
from see2act.modules.affordance import affordances
from see2act.modules.network import PixelNetwork
from see2act.modules.rotation import Rotations
from see2act.robot.end_effector import EndEffector

FILE = MODEL.name
"""Its name among a run's checkpoints."""
CONFIG, HASH = "see2act.config", "see2act.config_hash"
"""Names in the file's metadata."""
FITTING = ("model.name", "model.network", "primitive.end_effector", "workspace.pixel")
"""Keys that a run must share with the one whose model it starts from."""
WITHOUT = ("hydra", "paths", "logger")
"""Keys of the configuration that say nothing about the model."""


class ModelFileError(UserError, ValueError):
    """A file that is no trained model; the message is one line and says what to do."""


@dataclass(frozen=True)
class TrainedModel:
    """What picks, and what it learned with."""

    network: PixelNetwork
    config: DictConfig
    """Of the run that trained it, resolved; without what says nothing about the model."""
    config_hash: str

    @property
    def primitive(self) -> str:
        """``suction`` or ``grasp``."""
        return str(self.config.primitive.name)

    @property
    def pixel(self) -> float:
        """Metres a pixel of the heightmaps it learned from."""
        return float(self.config.workspace.pixel)

    def affordances(self, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "A H W"]:
        """Logits of success for every angle (a share k / A of half a turn) at every pixel of a heightmap of any size."""
        rotations = _rotations(
            height.shape, int(self.config.primitive.angles), self.network.stride, self.network.receptive_radius
        )
        return affordances(self.network, rotations.to(self.network.device), color, height)


def save(path: Path, network: PixelNetwork, cfg: DictConfig) -> None:
    """Write the network that acts, and the configuration it was trained by."""
    config = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key not in ("hydra", "logger")])
    plain: Any = OmegaConf.to_container(config, resolve=True)
    plain = {key: value for key, value in plain.items() if key not in WITHOUT}
    plain["robot"] = deciding_robot(cfg)
    metadata = {CONFIG: json.dumps(plain), HASH: config_hash(cfg)}
    state = {name: value.cpu().contiguous() for name, value in network.state_dict().items()}
    with replacing(path) as partial:
        partial.write_bytes(serialized(state, metadata))


def load(path: Path, primitive: str | None = None) -> TrainedModel:
    """Read what :func:`save` wrote.

    Args:
        path: The file.
        primitive: What it must have been trained for; None takes any.

    Raises:
        ModelFileError: It is not there, is another kind of file, or of another primitive.
    """
    if not path.is_file():
        raise ModelFileError(f"{path} is not there: give checkpoints/{FILE} of a finished run, or one of models/")
    try:
        metadata = _metadata(path)
        state = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ModelFileError(
            f"{path} cannot be read as safetensors ({error}): give checkpoints/{FILE} of a finished run, or one of models/"
        ) from None
    if CONFIG not in metadata:
        raise ModelFileError(f"{path} says nothing of its configuration: give checkpoints/{FILE} of a finished run")
    try:
        model = _model(metadata, state)
    except Exception as error:  # a file can say anything of itself
        raise ModelFileError(
            f"{path} holds no model of this version ({' '.join(str(error).split())[:200]}): give checkpoints/{FILE} of a "
            "finished run; for a network of your own, its module must be on PYTHONPATH"
        ) from None
    if primitive not in (None, model.primitive):
        raise ModelFileError(f"{path} was trained for primitive={model.primitive}, not {primitive}: give one of {primitive}")
    return model


def load_fitting(path: Path, cfg: DictConfig) -> TrainedModel:
    """The same, of a model that a run can start from: with the run's network, tool and size of a pixel.

    Raises:
        ModelFileError: As :func:`load`; or one of these is another.
    """
    model = load(path, cfg.primitive.name)
    for key in FITTING:
        if other := _difference(key, *(OmegaConf.select(config, key) for config in (model.config, cfg))):
            raise ModelFileError(
                f"{path} learned with {other}: type the same model=, primitive= and workspace= as for the run that it is of"
            )
    return model


def is_model(path: Path) -> bool:
    """Whether a file is one that :func:`save` wrote."""
    try:
        return CONFIG in _metadata(path)
    except (SafetensorError, OSError):
        return False


def _difference(key: str, theirs: Any, ours: Any) -> str | None:
    """The first key below this one that has two values, in words; None if there is none."""
    if not (OmegaConf.is_dict(theirs) and OmegaConf.is_dict(ours)):
        return f"{key}={theirs}, not {ours}" if theirs != ours else None
    below = (_difference(f"{key}.{name}", theirs.get(name), ours.get(name)) for name in {**theirs, **ours})
    return next(filter(None, below), None)


def _model(metadata: Mapping[str, str], state: dict[str, Tensor]) -> TrainedModel:
    config = OmegaConf.create(json.loads(metadata[CONFIG]))
    assert isinstance(config, DictConfig)
    network: PixelNetwork = instantiate(_harmless(config.model.network, PixelNetwork, "network"))
    network.load_state_dict(state)
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise ValueError("it has values that are no finite numbers")
    network.set_precision("fp32")  # exact, and the same on every processor
    model = TrainedModel(network.eval(), config, metadata[HASH])
    _harmless(config.primitive.end_effector, EndEffector, "tool")  # a prediction builds it
    name = config.primitive.name
    if not (isinstance(name, str) and re.fullmatch(WORD, name) and model.pixel > 0 and config.primitive.angles > 0):
        raise ValueError("its primitive or its workspace is none")
    return model


def _harmless(node: DictConfig, kind: type, word: str) -> DictConfig:
    """A node that builds a network or a tool, and nothing else that a file might want called.

    Raises:
        ValueError: It names something else.
    """
    if not issubclass(get_class(node._target_), kind) or any(OmegaConf.is_config(node[key]) for key in node):
        raise ValueError(f"{node._target_} is no {word} that is made of numbers and words")
    return node


def _metadata(path: Path) -> Mapping[str, str]:
    with safe_open(path, "pt") as file:
        return dict(file.metadata() or {})


@lru_cache(maxsize=2)  # hundreds of megabytes each, for a large heightmap with sixteen angles
def _rotations(shape: tuple[int, int], angles: int, stride: int, reach: int) -> Rotations:
    return Rotations(shape, angles, stride, reach)
