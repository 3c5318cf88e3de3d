"""Learning to act: the probability that a pick succeeds, for every pixel and angle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import lightning as L
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from see2act.modules.batchnorm import freeze
from see2act.modules.color_jitter import mixed
from see2act.modules.network import PixelNetwork
from see2act.modules.rotation import Rotations


class Augmentation(NamedTuple):
    """How each heightmap of a batch is augmented around the executed pixel."""

    mirror: Bool[Tensor, "B 2"]
    """Whether rows and columns are reversed."""
    rotation: Float[Tensor, " B"]
    """Rotation about the executed pixel, radians."""
    shift: Float[Tensor, "B 2"]
    """Shift along rows and columns, pixels."""
    mixtures: Float[Tensor, "B 3 4"]
    """Colour jitter: mixtures of colour channels for :func:`see2act.modules.color_jitter.mixed`."""


class AttemptBatch(NamedTuple):
    """Attempts to learn from: the heightmap, the executed pick, and whether it succeeded."""

    color: UInt8[Tensor, "B H W 3"]
    height: Float[Tensor, "B H W"]
    """Metres."""
    angle: Int[Tensor, " B"]
    """Index of the rotation."""
    row: Int[Tensor, " B"]
    col: Int[Tensor, " B"]
    label: Float[Tensor, " B"]
    """1 for a success, else 0."""
    weight: Float[Tensor, " B"]
    """Importance weights, at most 1."""
    replay_index: Int[Tensor, " B"]
    """Indices of the attempts in the replay."""
    augmentation: Augmentation | None = None
    """None leaves the heightmaps as they are."""


def affordances(
    network: PixelNetwork, rotations: Rotations, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"]
) -> Float[np.ndarray, "A H W"]:
    """Logits of success for every angle and pixel of a heightmap. The network's mode is not changed.

    Computed on the device of the network. ``rotations`` must be on the same device.
    """
    heightmap = (torch.from_numpy(array)[None].to(network.device) for array in (color, height))
    maps: np.ndarray = turned_logits(network, rotations, *heightmap).cpu().numpy()
    return maps


@torch.no_grad()
def turned_logits(
    network: PixelNetwork, rotations: Rotations, color: UInt8[Tensor, "1 H W 3"], height: Float[Tensor, "1 H W"]
) -> Float[Tensor, "A H W"]:
    """Like :func:`affordances`, for tensors on the network's device."""
    x = network.prepare(color, height)
    maps = torch.empty(rotations.count, *rotations.shape, device=x.device)
    for canvas, angles in rotations.by_canvas(network.together):
        maps[angles] = rotations.back(network(rotations.turned(x, angles, canvas)), angles).float()
    return maps


class AffordanceModule(L.LightningModule):
    """Trains a network on the single pixel where the robot picked.

    Args:
        network: The network, after the transfer.
        shape: Rows and columns of the heightmaps.
        angles: Number of rotations: 16 for grasping, 1 for suction.
        backbone_lr: Adam's learning rate of the backbone.
        head_lr: Adam's learning rate of the head.
        lr_warmup: Learning steps over which both rates rise from nearly zero. Adam's first steps are as large as all others,
            though they are estimated from very few attempts, and could undo what was transferred. 0 starts with the full rates.
        weight_decay: Weight decay of Adam.
        batchnorm: ``frozen`` uses the running statistics; ``batch`` uses those of each replay batch.
        averaging: Decay per learning step of the moving average of parameters and BatchNorm statistics. The averaged network
            acts and is evaluated, because the gradients of single pixels are noisy. 0 uses the latest parameters.
        averaging_warmup: After n steps the decay is at most (1 + n) / (averaging_warmup + n), as in TensorFlow's
            ``ExponentialMovingAverage``. So the average covers a constant share of the first steps, and a model whose first
            picks all fail soon makes others. 0 sets no such limit.
    """

    def __init__(
        self,
        network: PixelNetwork,
        *,
        shape: tuple[int, int],
        angles: int,
        backbone_lr: float,
        head_lr: float,
        lr_warmup: int,
        weight_decay: float,
        batchnorm: str,
        averaging: float,
        averaging_warmup: int,
    ):
        super().__init__()
        self.save_hyperparameters(ignore=["network"], logger=False)  # the run logs its whole configuration
        self.network = network
        self.average = AveragedModel(network, multi_avg_fn=_warming_up(averaging, averaging_warmup), use_buffers=True)
        self.rotations = Rotations(shape, angles, network.stride, network.receptive_radius)
        self._rates = {"backbone": backbone_lr, "head": head_lr}
        self._lr_warmup = lr_warmup
        self._weight_decay = weight_decay
        self._frozen = batchnorm == "frozen"
        self.train()

    @property
    def acting(self) -> PixelNetwork:
        """The network that decides: the averaged one, after the first learning step."""
        return cast(PixelNetwork, self.average.module) if self.average.n_averaged else self.network

    def affordances(self, color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "A H W"]:
        """:func:`affordances` of the network that acts."""
        training = self.training
        self.eval()
        maps = affordances(self.acting, self.rotations, color, height)
        self.train(training)
        return maps

    def training_step(self, batch: AttemptBatch, _: int) -> dict[str, Tensor]:
        """Binary cross-entropy at the executed pixels, weighted by importance, and the TD errors |prediction - label|."""
        logits = self.executed_logits(batch)
        losses = F.binary_cross_entropy_with_logits(logits, batch.label, reduction="none")
        loss = (losses * batch.weight).mean()
        self.log("affordance/loss", loss, batch_size=len(batch.label))
        return {"loss": loss, "td_error": (torch.sigmoid(logits.detach()) - batch.label).abs()}

    def on_train_batch_end(self, *_: Any) -> None:
        self.average.update_parameters(self.network)

    def executed_logits(self, batch: AttemptBatch) -> Float[Tensor, " B"]:
        """Logits at the executed pixels. All other pixels have zero loss (paper, section III-C).

        With frozen BatchNorm the network runs only on the window that the pixel depends on, which gives the same numbers.
        Batch statistics depend on every pixel, so they need the whole of the largest canvas.
        """
        varied = batch.augmentation
        x = self.network.prepare(mixed(batch.color, varied.mixtures) if varied else batch.color, batch.height)
        rotation, shift = (varied.rotation, varied.shift) if varied else (None, None)
        x, row, col = self.rotations.window(x, batch.angle, batch.row, batch.col, rotation, shift, whole=not self._frozen)
        if varied:
            x, row, col = _mirrored(x, row, col, varied.mirror)
        if self._frozen:
            return self.network.logits_at(x, row, col)
        executed: Tensor = self.network(x)[torch.arange(len(row), device=row.device), 0, row, col]
        return executed

    def train(self, mode: bool = True) -> AffordanceModule:
        super().train(mode)
        self.average.eval()
        if self._frozen:
            freeze(self.network)
        return self

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        groups = [{"params": getattr(self.network, part).parameters(), "lr": lr} for part, lr in self._rates.items()]
        optimizer = torch.optim.Adam(groups, weight_decay=self._weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: min(1.0, (step + 1) / max(1, self._lr_warmup)))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


Parameters = tuple[Tensor, ...] | list[Tensor]


def _warming_up(decay: float, warmup: int) -> Callable[[Parameters, Parameters, Tensor | int], None]:
    """For ``AveragedModel``, an exponential moving average whose decay rises to ``decay``."""

    def update(averaged: Parameters, latest: Parameters, steps: Tensor | int) -> None:
        most = (1 + int(steps)) / (warmup + int(steps))
        get_ema_multi_avg_fn(min(decay, most))(averaged, latest, steps)

    return update


def _mirrored(x: Tensor, row: Tensor, col: Tensor, mirror: Bool[Tensor, "B 2"]) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs (B, 4, h, w) with rows, columns or both in reverse order, and the mirrored positions of the pixels."""
    upside_down, left_right = mirror.T
    x = torch.where(upside_down[:, None, None, None], x.flip(2), x)
    x = torch.where(left_right[:, None, None, None], x.flip(3), x)
    row = torch.where(upside_down, x.shape[2] - 1 - row, row)
    return x, row, torch.where(left_right, x.shape[3] - 1 - col, col)
