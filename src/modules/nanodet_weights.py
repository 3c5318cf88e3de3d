"""NanoDet-g's COCO weights, from upstream's checkpoints or from TensorFlow.js, converted to the keys of our network."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from see2act.errors import MissingWeights, TransferError
from see2act.modules import weights
from see2act.modules.nanodet import CLASSES, NanoDet

FILE = Path("weights", "nanodet_g_coco.safetensors")
"""Path in the cache to which ``make coco`` writes the weights."""
BGR_MEAN, BGR_STD = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
"""Mean and standard deviation of its training images, 0..255. They are ImageNet's, with the channels in OpenCV's order."""
UPSTREAM_EPSILON = 1e-5
"""Epsilon of upstream's BatchNorm."""
PREFIXES = ("avg_model.", "model.", "module.", "")
"""Prefixes of the keys of a checkpoint, in order of preference. Averaged weights come first, as upstream evaluates those."""
RENAMED = (
    (re.compile(r"^fpn\.lateral_convs\.(\d)\.conv\."), r"backbone.laterals.\1."),
    (re.compile(r"^head\.cls_convs\.0\.0\."), "head.conv."),
    (re.compile(r"^head\.gfl_cls\.0\."), "head.logits."),
)
"""Upstream's keys and ours, where they differ; the keys of the backbone do not. The first of upstream's three levels has
stride 8."""


@dataclass(frozen=True)
class NanoDetWeights:
    """Reads NanoDet-g's weights from a given file, or from the cache, where ``make coco`` puts them."""

    def read(self, file: str | None, cache: Path) -> dict[str, Tensor]:
        """See :class:`see2act.modules.weights.OffTheShelf`. The state is of a :class:`NanoDet` without depth.

        Args:
            file: Upstream's checkpoint, or a file with our keys.
            cache: Cache folder of the project.
        """
        path = Path(file) if file else cache / FILE
        if not file and not path.exists():
            raise MissingWeights(
                f"{path} is not here: get NanoDet-g's COCO weights with make coco, or name upstream's checkpoint with "
                "task.weights=FILE"
            )
        state = weights.read(path)
        return state if "normalization.mean" in state else from_upstream(state)


def from_upstream(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert a checkpoint of github.com/RangiLyu/nanodet. BatchNorm is kept; boxes and the scores of other levels are dropped.

    Raises:
        TransferError: The checkpoint is of another network.
    """
    prefix = next(p for p in PREFIXES if any(key.startswith(f"{p}backbone.") for key in state) or not p)
    ours: dict[str, Tensor] = {}
    for key, value in state.items():
        name = key.removeprefix(prefix)
        for pattern, new in RENAMED:
            name = pattern.sub(new, name)
        ours[name] = value.float() if value.is_floating_point() else value
        if name.endswith("running_mean"):
            ours[name.replace("running_mean", "epsilon")] = torch.tensor(UPSTREAM_EPSILON)
            ours.setdefault(name.replace("running_mean", "num_batches_tracked"), torch.tensor(0))
    return _checked(ours)


def from_tfjs(graph: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Convert the weights of its TensorFlow.js graph, in which each BatchNorm is folded into the convolution before it.

    So in the converted network each BatchNorm only adds the bias.

    Args:
        graph: Weights by name, as returned by :func:`see2act.modules.tfjs.read`.

    Raises:
        TransferError: The graph is of another network.
    """
    state: dict[str, Tensor] = {}
    for n, name in enumerate(_convolutions()):
        # The graph has two more numbered constants before the biases of the heads.
        kernel, bias = f"PartitionedCall/split{f'_{n}' if n else ''}", f"unknown_{2 * n + 4 * name.startswith('head.')}"
        if kernel not in graph or bias not in graph or graph[kernel].ndim != 4:
            raise TransferError(f"the graph has no {kernel} or no {bias}: bring NanoDet-g's, no other NanoDet fits")
        state[f"{name}.weight"] = torch.from_numpy(graph[kernel]).permute(3, 2, 0, 1).contiguous()
        added = torch.from_numpy(graph[bias].copy())
        if not name.endswith(".conv"):
            state[f"{name}.bias"] = added
            continue
        norm = name.removesuffix("conv") + "bn"
        state |= {f"{norm}.{key}": torch.ones_like(added) for key in ("weight", "running_var")}
        state |= {f"{norm}.bias": added, f"{norm}.running_mean": torch.zeros_like(added)}
        state |= {f"{norm}.num_batches_tracked": torch.tensor(0), f"{norm}.epsilon": torch.tensor(0.0)}
    return _checked(state)


def _convolutions() -> list[str]:
    """Names of all convolutions in the order of the graph."""
    return [key.removesuffix(".weight") for key, value in _expected().items() if value.ndim == 4]


def _expected() -> dict[str, Tensor]:
    with torch.device("meta"):
        return NanoDet(depth="none").state_dict()


BOX = 4 * 11
"""Rows that upstream's head has beside the classes: a distribution over 11 distances for each side of a box."""


def _checked(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The part of a state that our network needs. Converts the input from BGR to RGB and drops the box predictions."""
    expected = _expected()
    for part in ("weight", "bias"):
        if (name := f"head.logits.{part}") in state:
            if len(state[name]) not in (CLASSES, CLASSES + BOX):
                raise TransferError(f"{name} has {len(state[name])} rows: bring NanoDet-g's of COCO's {CLASSES} classes")
            state[name] = state[name][:CLASSES].contiguous()
    ours = {name: state[name] for name in expected if name in state and not name.startswith("normalization.")}
    for name, value in expected.items():
        if name.startswith("normalization."):
            continue
        if name not in ours:
            raise TransferError(f"the weights have no {name}: bring NanoDet-g's, no other NanoDet fits")
        if ours[name].shape != value.shape:
            raise TransferError(
                f"{name} is {list(ours[name].shape)} there and {list(value.shape)} here: bring NanoDet-g's, no other fits"
            )
    first = "backbone.stages.0.conv.weight"
    ours[first] = ours[first].flip(1).contiguous()
    for name, values in (("mean", BGR_MEAN), ("std", BGR_STD)):
        ours[f"normalization.{name}"] = torch.tensor(values[::-1]) / 255
    return ours
