"""Stage 3: the affordance model before its first attempt."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from see2act.datamodules.collect import Collection
from see2act.datamodules.vision import channel_statistics
from see2act.errors import TransferError
from see2act.experiment import build
from see2act.experiment.stages.pretrain import given_weights
from see2act.modules.affordance import AffordanceModule
from see2act.modules.batchnorm import batchnorms, epsilons, estimate
from see2act.modules.network import PixelNetwork
from see2act.modules.transfer import TransferReport, copy_parts
from see2act.seeding import generator, seed_for

ESTIMATION_MAPS = 64
"""Unlabelled heightmaps from which BatchNorm statistics of uncopied layers are estimated."""


def affordance_model(
    cfg: DictConfig, collection: Collection | None, vision: dict[str, Any] | None
) -> tuple[AffordanceModule, TransferReport]:
    """Copy the configured parts of the source into a new affordance model, and say what became of every key.

    Args:
        cfg: Of the run.
        collection: Input statistics are measured on it, and BatchNorm statistics of layers that are not copied. None where the
            source is an affordance model that is copied whole: it has both.
        vision: The source's checkpoint; None copies nothing.
    """
    network = build.network(cfg, seed_for("head", cfg.seed))
    if collection:
        network.normalization.set(*channel_statistics(collection))
    report = copy_transferred(cfg, vision["network"] if vision else {}, network)
    if "head" in cfg.transfer.parts and not cfg.task.affordance:  # one that has learned to pick is as sure as it should be
        network.scale_logits(cfg.finetune.logit_scale)
    module = AffordanceModule(
        network,
        shape=instantiate(cfg.workspace).shape,
        angles=cfg.primitive.angles,
        backbone_lr=cfg.finetune.backbone_lr,
        head_lr=cfg.finetune.head_lr,
        lr_warmup=cfg.finetune.lr_warmup,
        weight_decay=cfg.finetune.weight_decay,
        batchnorm=cfg.finetune.batchnorm,
        averaging=cfg.finetune.averaging,
        averaging_warmup=cfg.finetune.averaging_warmup,
    )
    module.to(build.device(cfg))
    if collection:
        fresh = [name for name in batchnorms(network) if name.split(".")[0] not in cfg.transfer.parts]
        estimate(network, _unlabelled(module, collection, cfg.collect.seed), fresh)
    return module.eval(), report


def copy_transferred(cfg: DictConfig, source: dict[str, Tensor], network: PixelNetwork) -> TransferReport:
    """Copy the parts that ``transfer=`` names."""
    return copy_parts(source, network, cfg.transfer.parts, cfg.task.optional, cfg.task.zero)


def check_weights(cfg: DictConfig) -> None:
    """Refuse given weights that do not fit, before any work.

    Raises:
        TransferError: Keys or shapes differ.
        ModelFileError: Of ``task=affordance``: it has another network, tool or size of a pixel.
        MissingWeights: They are not on this machine.
    """
    if not (cfg.task.weights or cfg.task.off_the_shelf):
        return
    network = build.network(cfg, 0)
    copy_transferred(cfg, given_weights(cfg, network.normalization.mean, network.normalization.std), network)
    if cfg.finetune.batchnorm == "batch" and any(float(epsilon) == 0 for epsilon in epsilons(network)):
        raise TransferError(
            "the BatchNorm of these weights has an epsilon of 0, since their detector froze it or folded it into its "
            "convolutions, and cannot use the statistics of batches: leave finetune.batchnorm=frozen"
        )


def _unlabelled(module: AffordanceModule, collection: Collection, seed: int) -> Iterator[Tensor]:
    """The same heightmaps for every run, rotated as the primitive will see them."""
    chosen = generator("unlabelled", seed)
    device = module.network.device
    count = min(ESTIMATION_MAPS, len(collection))
    for start in range(0, count, 8):
        index = slice(start, min(start + 8, count))
        color = torch.from_numpy(collection.arrays["color"][index])
        height = torch.from_numpy(collection.arrays["height"][index])
        angle = torch.from_numpy(chosen.integers(module.rotations.count, size=len(color)))
        x = module.network.prepare(color.to(device), height.to(device))
        yield module.rotations.turned(x, angle.to(device))
