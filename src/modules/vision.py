"""Learning to see: a binary label for every pixel."""

from __future__ import annotations

import math
from typing import NamedTuple

import lightning as L
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor

from see2act.modules.network import PixelNetwork
from see2act.modules.rotation import sampling_grid, warp, warp_nearest
from see2act.seeding import seed_for


class VisionBatch(NamedTuple):
    """Heightmaps and their labels."""

    color: UInt8[Tensor, "B H W 3"]
    height: Float[Tensor, "B H W"]
    """Metres."""
    label: Bool[Tensor, "B H W"]


class VisionModule(L.LightningModule):
    """Trains a network on a vision task, from heightmaps and label maps.

    Heightmaps are rotated by a random angle, mirrored and shifted, because the affordance model will see rotated ones. The
    learning rate falls to zero over all steps along a cosine.

    Args:
        network: The network to train.
        lr: Peak learning rate of AdamW.
        weight_decay: Weight decay of AdamW.
        pos_weight: Weight of a positive pixel relative to a negative one.
        seed: Seed of the augmentation. With several processes (ddp) each one derives its own seed from it.
    """

    def __init__(self, network: PixelNetwork, *, lr: float, weight_decay: float, pos_weight: float, seed: int):
        super().__init__()
        self.save_hyperparameters(ignore=["network"], logger=False)  # the run logs its whole configuration
        self.network = network
        self._lr, self._weight_decay = lr, weight_decay
        self.register_buffer("pos_weight", torch.tensor(pos_weight), persistent=False)
        self._seed, self._augment = seed, torch.Generator().manual_seed(seed)

    def forward(self, color: UInt8[Tensor, "B H W 3"], height: Float[Tensor, "B H W"]) -> Float[Tensor, "B 1 H W"]:
        """Logits of heightmaps without rotation."""
        logits: Tensor = self.network(self.network.prepare(color, height))
        return logits

    def on_fit_start(self) -> None:
        if self.global_rank:
            self._augment.manual_seed(seed_for("augment", self._seed, self.global_rank))

    def training_step(self, batch: VisionBatch, _: int) -> Tensor:
        x = self.network.prepare(batch.color, batch.height)
        x, label = self._augmented(x, batch.label)
        loss = self.loss(self.network(x), label)
        self.log("vision/loss", loss, prog_bar=True)
        return loss

    def validation_step(self, batch: VisionBatch, _: int) -> None:
        loss = self.loss(self(batch.color, batch.height), batch.label[:, None].float())
        self.log("vision/val_loss", loss, prog_bar=True, batch_size=len(batch.label))

    def loss(self, logits: Float[Tensor, "B 1 h w"], label: Float[Tensor, "B 1 h w"]) -> Tensor:
        """Binary cross-entropy over all pixels (paper, section III-B)."""
        assert isinstance(self.pos_weight, Tensor)
        return F.binary_cross_entropy_with_logits(logits, label, pos_weight=self.pos_weight)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = torch.optim.AdamW(self.network.parameters(), lr=self._lr, weight_decay=self._weight_decay)
        steps = int(self.trainer.estimated_stepping_batches)  # fewer with several devices, which share each epoch
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _augmented(self, x: Float[Tensor, "B 4 H W"], label: Bool[Tensor, "B H W"]) -> tuple[Tensor, Tensor]:
        """Inputs and labels, randomly rotated, mirrored and shifted, at the same size."""
        n, shape = len(x), (x.shape[2], x.shape[3])
        angle = torch.rand(n, generator=self._augment) * 2 * math.pi
        shift = (torch.rand(n, 2, generator=self._augment) - 0.5) * torch.tensor(shape) * 0.4
        grid = sampling_grid(angle, shape, shape, shift)
        mirrored = torch.rand(n, generator=self._augment) < 0.5
        grid = torch.where(mirrored[:, None, None, None], grid.flip(2), grid).to(x.device)
        return warp(x, grid), warp_nearest(label[:, None].float(), grid)
