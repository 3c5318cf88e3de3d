"""Learning to act: the probability that a pick succeeds, at every pixel and angle."""

from __future__ import annotations

import lightning as L
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from see2act.modules.batchnorm import freeze
from see2act.modules.network import TOGETHER, PixelNetwork
from see2act.modules.rotation import Rotations
from torch import Tensor


class AffordanceModule(L.LightningModule):
    """A network that learns from the single pixel where the robot tried.

    Args:
        network: The shared architecture, after a transfer.
        shape: Rows and columns of the heightmaps.
        angles: Rotations to consider: 16 for grasping, 1 for suction.
        backbone_lr: Adam's learning rate of the backbone.
        head_lr: Adam's learning rate of the head.
        weight_decay: Adam's.
        batchnorm: ``frozen`` keeps running statistics, ``batch`` uses those of each replay batch.
    """

    def __init__(
        self,
        network: PixelNetwork,
        shape: tuple[int, int],
        angles: int,
        backbone_lr: float,
        head_lr: float,
        weight_decay: float,
        batchnorm: str,
    ):
        super().__init__()
        self.network = network
        self.rotations = Rotations(shape, angles, network.stride)
        self._rates = {"backbone": backbone_lr, "head": head_lr}
        self._weight_decay = weight_decay
        self._frozen = batchnorm == "frozen"
        self.surprise: Tensor | None = None
        """|prediction - label| of the last batch, for the replay's priorities."""
        self.train()

    @torch.no_grad()
    def affordances(self, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "A H W"]:
        """Logits of success for every angle at every pixel of the heightmap, with frozen statistics."""
        training = self.training
        self.eval()
        x = self.network.prepare(torch.from_numpy(color)[None], torch.from_numpy(height)[None])
        turned = self.rotations.all(x).split(TOGETHER)
        maps = self.rotations.back(torch.cat([self.network(maps) for maps in turned]))
        self.train(training)
        return maps.float().numpy()

    def training_step(self, batch: dict[str, Tensor], _: int) -> Tensor:
        logits = self.executed_logits(batch)
        losses = F.binary_cross_entropy_with_logits(logits, batch["label"], reduction="none")
        self.surprise = (torch.sigmoid(logits.detach()) - batch["label"]).abs()
        loss = (losses * batch["weight"]).mean()
        self.log("affordance/loss", loss)
        return loss

    def executed_logits(self, batch: dict[str, Tensor]) -> Float[Tensor, " B"]:
        """Logits at the executed pixels only; all others have zero loss (paper, section III-C).

        With frozen statistics the network runs on the window that the pixel depends on, which gives the same
        numbers. Statistics of the batch depend on every pixel, so there the whole canvas is used.
        A batch may say which of its turned heightmaps to mirror.
        """
        x = self.network.prepare(batch["color"], batch["height"])
        angle, row, col = batch["angle"], batch["row"], batch["col"]
        if self._frozen:
            x, row, col = self.rotations.window(x, angle, row, col, self.network.reach)
        else:
            x, (row, col) = self.rotations.turned(x, angle), self.rotations.locate(angle, row, col)
        if "mirror" in batch:
            x, row, col = _mirrored(x, row, col, batch["mirror"])
        if self._frozen:
            return self.network.logits_at(x, row, col)
        executed: Tensor = self.network(x)[torch.arange(len(row)), 0, row, col]
        return executed

    def train(self, mode: bool = True) -> AffordanceModule:
        super().train(mode)
        if self._frozen:
            freeze(self.network)
        return self

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [{"params": getattr(self.network, part).parameters(), "lr": lr} for part, lr in self._rates.items()]
        return torch.optim.Adam(groups, weight_decay=self._weight_decay)


def _mirrored(x: Tensor, row: Tensor, col: Tensor, mirror: Bool[Tensor, "B 2"]) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs (B, 4, h, w) with rows, columns or both in reverse order, and the pixels in them."""
    upside_down, left_right = mirror.T
    x = torch.where(upside_down[:, None, None, None], x.flip(2), x)
    x = torch.where(left_right[:, None, None, None], x.flip(3), x)
    row = torch.where(upside_down, x.shape[2] - 1 - row, row)
    return x, row, torch.where(left_right, x.shape[3] - 1 - col, col)
