"""The architecture that vision and affordance models share: normalise, backbone, head."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn


class Normalization(nn.Module):
    """Mean and standard deviation of the four input channels (R, G, B in 0..1, height in metres).

    They belong to the source model: measured on its training set, saved in its checkpoint and carried along
    by every transfer.
    """

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(4))
        self.register_buffer("std", torch.ones(4))

    def set(self, mean: Float[Tensor, "4"], std: Float[Tensor, "4"]) -> None:
        """Take over measured statistics."""
        self.mean.copy_(mean)
        self.std.copy_(std)

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        return (x - self.mean[:, None, None]) / self.std[:, None, None]


class PixelNetwork(nn.Module):
    """RGB-D heightmap in, one logit a pixel out.

    A subclass, or whoever builds one, provides ``backbone`` (B, 4, H, W) -> features and ``head`` features ->
    (B, 1, H, W). Everything a transfer can copy lives under one of those two names.

    Args:
        backbone: Feature extractor.
        head: Prediction layers.
        stride: Input sides must be multiples of this.
        reach: Pixels around a logit that can influence it, on each side.
    """

    def __init__(self, backbone: nn.Module, head: nn.Module, stride: int, reach: int):
        super().__init__()
        self.normalization = Normalization()
        self.backbone = backbone
        self.head = head
        self.stride = stride
        self.reach = reach

    def prepare(self, color: UInt8[Tensor, "B H W 3"], height: Float[Tensor, "B H W"]) -> Float[Tensor, "B 4 H W"]:
        """Normalised network input; zero is the average pixel, which is also what padding looks like."""
        rgb = color.permute(0, 3, 1, 2).to(height.dtype) / 255
        x: Tensor = self.normalization(torch.cat([rgb, height[:, None]], dim=1))
        return x

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 1 H W"]:
        """Logits of prepared input."""
        logits: Tensor = self.head(self.backbone(x))
        return logits
