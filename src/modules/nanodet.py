"""A small one-stage detector that gives a heatmap: NanoDet-g of github.com/RangiLyu/nanodet."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from see2act.modules.batchnorm import BatchNorm
from see2act.modules.network import Logits, PixelNetwork, check_input, crop, magnified

CLASSES = 80
"""Number of classes in COCO."""
STRIDE = 8
"""Stride of the pyramid's finest level."""
COARSEST = 32
"""Stride of the coarsest feature map."""
PYRAMID_CHANNELS = 128
RADIUS = 2
"""Receptive-field radius of a logit after the pyramid, in features of the finest level: a convolution and an upsampling."""
SLOPE = 0.1
"""Negative slope of every LeakyReLU."""


class Convolution(nn.Module):
    """A 3x3 convolution, BatchNorm and LeakyReLU, (B, in, H, W) -> (B, out, H / stride, W / stride)."""

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1):
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, 3, stride, padding=1, bias=False)
        self.bn = BatchNorm(channels_out)
        nn.init.kaiming_normal_(self.conv.weight, a=SLOPE, nonlinearity="leaky_relu")

    def forward(self, x: Float[Tensor, "B c H W"], beside: Tensor | None = None) -> Float[Tensor, "B d h w"]:
        """``beside`` (B, d, h, w) is added to the output of the convolution."""
        y = self.conv(x)
        return F.leaky_relu(self.bn(y if beside is None else y + beside), SLOPE)


class Pair(nn.Module):
    """Two convolutions in sequence with half of the channels each; their outputs are concatenated. The shape stays the same."""

    def __init__(self, channels: int):
        super().__init__()
        self.in_conv = Convolution(channels, channels // 2)
        self.mid_conv = Convolution(channels // 2, channels // 2)

    def forward(self, x: Float[Tensor, "B c H W"]) -> Float[Tensor, "B c H W"]:
        y = self.in_conv(x)
        return torch.cat([self.mid_conv(y), y], dim=1)


class Stage(nn.Module):
    """A cross-stage partial block (Wang et al. 2020), (B, c, H, W) -> (B, 2 c, H / stride, W / stride)."""

    def __init__(self, channels: int, pairs: int, stride: int):
        super().__init__()
        self.in_conv = Convolution(channels, channels, stride)
        self.res_blocks = nn.Sequential(*(Pair(channels) for _ in range(pairs)))
        self.res_out_conv = Convolution(channels, channels)

    def forward(self, x: Float[Tensor, "B c H W"]) -> Float[Tensor, "B d h w"]:
        x = self.in_conv(x)
        return torch.cat([self.res_out_conv(self.res_blocks(x)), x], dim=1)


class Backbone(nn.Module):
    """RGB-D to the finest level of a feature pyramid, (B, 4, H, W) -> (B, 128, scale H / 8, scale W / 8).

    The modules have upstream's names. The depth enters through a separate convolution, ``depth``, whose output is added to
    that of the first one. It is set to zero for weights that never saw depth.

    Args:
        scale: Factor by which the input is enlarged first.
        depth: ``early`` adds the depth at the first convolution; ``none`` leaves it out.
    """

    def __init__(self, scale: int, depth: str):
        super().__init__()
        self.scale = scale
        first = Convolution(3, 32, stride=2)
        stages = [Stage(32, 1, 1), Stage(64, 2, 2), Stage(128, 2, 2), Stage(256, 3, 2)]
        self.stages = nn.ModuleList([first, nn.MaxPool2d(3, 2, padding=1), *stages])
        self.laterals = nn.ModuleList(_lateral(channels) for channels in (128, 256, 512))
        self.depth = nn.Conv2d(1, 32, 3, 2, padding=1, bias=False) if depth == "early" else None
        if self.depth is not None:
            nn.init.kaiming_normal_(self.depth.weight, a=SLOPE, nonlinearity="leaky_relu")

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 128 h w"]:
        x = magnified(x, self.scale)
        first, *others = self.stages
        y = first(x[:, :3], None if self.depth is None else self.depth(x[:, 3:]))
        features = []
        for stage in others:
            y = stage(y)
            features.append(y)
        merged: Tensor | None = None
        for lateral, feature in zip(reversed(self.laterals), reversed(features), strict=False):
            merged = lateral(feature) if merged is None else lateral(feature) + enlarged(merged, 2)
        assert merged is not None
        return merged


def _lateral(channels: int) -> nn.Conv2d:
    layer = nn.Conv2d(channels, PYRAMID_CHANNELS, 1)
    nn.init.xavier_uniform_(layer.weight)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


class Head(nn.Module):
    """Scores of all classes at each feature of the finest level. The highest one, upsampled to the input's size, is the logit.

    Args:
        scale: Factor by which the input was enlarged; the output is as large as the input before that.
    """

    def __init__(self, scale: int):
        super().__init__()
        self.factor = STRIDE / scale
        self.conv = Convolution(PYRAMID_CHANNELS, PYRAMID_CHANNELS)
        self.logits = Logits(PYRAMID_CHANNELS, CLASSES, 1)
        self.logits.start_unsure()  # the highest of 80 still grows with the length of the features: docs/differences.md, 8

    def forward(self, x: Float[Tensor, "B 128 h w"]) -> Float[Tensor, "B 1 H W"]:
        return enlarged(self.logits(self.conv(x)).amax(1, keepdim=True), self.factor)


def enlarged(x: Float[Tensor, "B C h w"], factor: float) -> Float[Tensor, "B C H W"]:
    """Bilinear upsampling. In this detector feature j is centred on the pixel ``factor`` (j + 0.5)."""
    return F.interpolate(x, scale_factor=float(factor), mode="bilinear", align_corners=False)


class NanoDet(PixelNetwork):
    """The class scores of NanoDet-g's finest level as a heatmap. It has 3.5 million parameters.

    Args:
        scale: Factor by which the input is enlarged first: 1, 2 or 4. The detector was trained on objects of 16 px and more.
        depth: How the depth enters the network: ``early`` or ``none``.

    Raises:
        ValueError: ``scale`` or ``depth`` is unknown.
    """

    def __init__(self, scale: int = 2, depth: str = "early"):
        check_input(depth, scale)
        # The receptive field reaches 420 px to each side; nine tenths of a logit's gradient lie within 140 px (both of the
        # enlarged input).
        super().__init__(Backbone(scale, depth), Head(scale), stride=COARSEST // scale, receptive_radius=-(-424 // scale))
        self.scale = scale

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input. The head runs only on the features that the logit depends on."""
        with self.autocast():
            features = self.backbone(self.entering(x))
            features, row, col = crop(features, row, col, STRIDE // self.scale, RADIUS)
            logits: Tensor = self.head(features)
        return logits[torch.arange(len(x), device=x.device), 0, row, col].float()
