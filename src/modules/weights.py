"""Weights from files and from torchvision, converted to the keys of our networks."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
import torchvision
from safetensors.torch import load_file
from torch import Tensor

from see2act.errors import MissingWeights, TransferError

OLD_FPN = re.compile(r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d)\.(weight|bias)$")
OLD_HEAD = re.compile(r"^head\.conv\.(weight|bias)$")
"""Keys of torchvision's older detectors. They lack the index of the convolution within its block."""


class OffTheShelf(Protocol):
    """A source of weights that others trained."""

    def read(self, file: str | None, cache: Path) -> dict[str, Tensor]:
        """A state dict with the keys of our networks, from ``file`` or from where such weights are kept.

        The input statistics are of RGB only, shape (3,), if the file has none for the height. The caller adds those.

        Args:
            file: The file that the user named, if any.
            cache: Cache folder of the project.

        Raises:
            TransferError: The file cannot be read, or is of another network.
            MissingWeights: No file was named, and the weights are not on this machine and cannot be downloaded.
        """


@dataclass(frozen=True)
class Torchvision:
    """torchvision's weights, and the constants that belong to them.

    Args:
        weights: A torchvision model and one of its weights: ``resnet50.IMAGENET1K_V1``.
        mean, std: Statistics of the RGB channels (0..1) that they were trained with.
        epsilon: Epsilon of their BatchNorm.
        epsilon_of: Epsilon by model, for models with another value. 0 holds for frozen BatchNorm only.
    """

    weights: str
    mean: Sequence[float]
    std: Sequence[float]
    epsilon: float
    epsilon_of: Mapping[str, float] = field(default_factory=dict)

    def read(self, file: str | None, cache: Path) -> dict[str, Tensor]:
        """See :class:`OffTheShelf`. Without a ``file``, the weights come from torchvision's cache or its download."""
        state = to_our_keys(read(Path(file)) if file else self._download())
        if "normalization.mean" in state:
            return state  # a checkpoint of this project, which is complete
        epsilon = self.epsilon_of.get(self.weights.split(".")[0], self.epsilon)
        if epsilon == 0 and any(key.endswith("num_batches_tracked") for key in state):
            epsilon = self.epsilon  # only frozen BatchNorm, which does not count batches, is without one
        for layer in [key.removesuffix("running_mean") for key in state if key.endswith("running_mean")]:
            state.setdefault(f"{layer}num_batches_tracked", torch.tensor(0))
            state[f"{layer}epsilon"] = torch.tensor(epsilon)
        return state | {"normalization.mean": torch.tensor([*self.mean]), "normalization.std": torch.tensor([*self.std])}

    def _download(self) -> Mapping[str, Tensor]:
        model, member = self.weights.split(".")
        try:
            weights = torchvision.models.get_model_weights(model)[member]
        except (ValueError, KeyError):
            raise TransferError(
                f"torchvision has no {self.weights}: choose another model.backbone (of task=coco: resnet50 or "
                "mobilenet_v3_large), or bring weights with task.weights=FILE"
            ) from None
        name = weights.url.rsplit("/", 1)[1]
        kept = Path(torch.hub.get_dir()) / "checkpoints" / name
        if kept.exists():
            return _verified(kept)
        try:
            state: Mapping[str, Tensor] = weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
        except (OSError, RuntimeError) as error:
            raise MissingWeights(
                f"{self.weights} cannot be downloaded here ({error}): bring {name} from another machine and put it into "
                f"{kept.parent}, or name it with task.weights=FILE"
            ) from None
        return state


def _verified(path: Path) -> dict[str, Tensor]:
    """A file of torchvision, whose name ends in the first digits of its sha256: ``resnet50-0676ba61.pth``."""
    digits = re.search(r"-([0-9a-f]{8})\.", path.name)
    if digits and not hashlib.sha256(path.read_bytes()).hexdigest().startswith(digits[1]):
        raise TransferError(f"{path} is damaged, its sha256 does not begin with {digits[1]}: delete it, or bring it again")
    return read(path)


def read(path: Path) -> dict[str, Tensor]:
    """The state dict in a file: .safetensors, or a file written by ``torch.save``. Code in a file is never run.

    Checkpoints that keep the state dict under a key, such as those of this project, work too.

    Raises:
        TransferError: The file does not exist, is broken, would run code, or holds no state dict.
    """
    content = _content(path)
    for name in ("network", "state_dict", "model"):
        if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
            content = content[name]
    if not isinstance(content, Mapping) or not content or not all(isinstance(v, Tensor) for v in content.values()):
        raise TransferError(f"{path} holds no state dict: bring the file that torch.save(model.state_dict(), ...) writes")
    return dict(content)


def task_of(path: Path) -> str | None:
    """The vision task of a checkpoint of this project; None if the file does not name one.

    Raises:
        TransferError: The file does not exist, is broken, or would run code.
    """
    content = _content(path)
    ours = isinstance(content, Mapping) and "network" in content and isinstance(content.get("task"), str)
    return str(content["task"]) if ours else None


def _content(path: Path) -> Any:
    try:
        return load_file(path) if path.suffix == ".safetensors" else torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file makes torch.load raise anything
        if foreign := re.search(r"GLOBAL ([\w.]+)", str(error)):
            raise TransferError(
                f"{path} holds a {foreign[1]}, which is not loaded since it could run code: where you trust the file, save its "
                "state dict alone, with torch.save(torch.load(path, weights_only=False)['state_dict'], new_path)"
            ) from None
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise TransferError(f"{path} cannot be read ({reason}): bring weights as a .pth or .safetensors file") from None


def to_our_keys(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename torchvision's keys to ours. They may be of a detector (old or new), a backbone with or without its pyramid, or a
    classifier.

    Keys that belong to no part of our networks stay as they are. The transfer reports them as unused.
    """
    names = {key: _rename(key, state) for key in state}
    return {ours: state[theirs] for theirs, ours in names.items()}


def _rename(key: str, state: Mapping[str, Tensor]) -> str:
    if "features.0.0.weight" in state:
        key = key.replace("features.", "backbone.body.", 1) if key.startswith("features.") else key  # a MobileNet
    elif "conv1.weight" in state and key.split(".")[0] not in ("fc", "avgpool"):
        key = f"backbone.body.{key}"  # a classifier, or its body
    elif "body.conv1.weight" in state:
        key = f"backbone.{key}"  # a backbone alone
    elif key.startswith("rpn.head."):
        key = key.removeprefix("rpn.")
    key = OLD_FPN.sub(r"\1.0.\2", key)
    return OLD_HEAD.sub(r"head.conv.0.0.\1", key)
