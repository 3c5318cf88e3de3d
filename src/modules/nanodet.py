"""A small one-stage detector as a heatmap: NanoDet-g of github.com/RangiLyu/nanodet."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from see2act.modules.batchnorm import BatchNorm
from see2act.modules.network import Logits, PixelNetwork, check_input, crop, magnified
from torch import Tensor, nn

CLASSES = 80
"""Of COCO."""
STRIDE = 8
"""Of the pyramid's finest level."""
COARSEST = 32
"""Stride of the coarsest feature map."""
PYRAMID_CHANNELS = 128
REACH = 2
"""Features of the finest level, to each side, that a logit depends on after the pyramid: a convolution and an enlargement."""
SLOPE = 0.1
"""Of every LeakyReLU."""


class Convolution(nn.Module):
    """A 3x3 convolution, BatchNorm and LeakyReLU, (B, in, H, W) -> (B, out, H / stride, W / stride)."""

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1):
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, 3, stride, padding=1, bias=False)
        self.bn = BatchNorm(channels_out)
        nn.init.kaiming_normal_(self.conv.weight, a=SLOPE, nonlinearity="leaky_relu")

    def forward(self, x: Float[Tensor, "B c H W"], beside: Tensor | None = None) -> Float[Tensor, "B d h w"]:
        """``beside`` (B, d, h, w) is added to what the convolution gives."""
        y = self.conv(x)
        return F.leaky_relu(self.bn(y if beside is None else y + beside), SLOPE)


class Pair(nn.Module):
    """Two convolutions of half the channels each, one after the other, side by side: the shape stays."""

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

    The modules have upstream's names. The depth enters through ``depth``, a convolution beside the first one whose result
    is added to it, which weights that never saw depth make zero.

    Args:
        scale: By how much the input is enlarged before.
        depth: ``early`` adds the depth at the first convolution, ``none`` leaves it out.
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
    """Scores of all classes at each place of the finest level; the highest, at every pixel of the input.

    Args:
        scale: Of the input's enlargement, which is undone.
    """

    def __init__(self, scale: int):
        super().__init__()
        self.factor = STRIDE / scale
        self.conv = Convolution(PYRAMID_CHANNELS, PYRAMID_CHANNELS)
        self.logits = Logits(PYRAMID_CHANNELS, CLASSES, 1)
        self.logits.start_unsure()  # the highest of 80 follows the length of the features all the same: docs/differences.md, 8

    def forward(self, x: Float[Tensor, "B 128 h w"]) -> Float[Tensor, "B 1 H W"]:
        return enlarged(self.logits(self.conv(x)).amax(1, keepdim=True), self.factor)


def enlarged(x: Float[Tensor, "B C h w"], factor: float) -> Float[Tensor, "B C H W"]:
    """Bilinear. The detector learned that the feature j stands for the pixels around ``factor`` (j + 0.5)."""
    return F.interpolate(x, scale_factor=float(factor), mode="bilinear", align_corners=False)


class NanoDet(PixelNetwork):
    """NanoDet-g's classification of its finest level as a heatmap: 3.5 million parameters.

    Args:
        scale: By how much the input is enlarged before: 1, 2 or 4. The detector learned from objects of 16 px and more.
        depth: How the depth enters: ``early`` or ``none``.

    Raises:
        ValueError: There is no such ``scale`` or ``depth``.
    """

    def __init__(self, scale: int = 2, depth: str = "early"):
        check_input(depth, scale)
        # It could see 420 px to each side; nine tenths of a logit's gradient lie within 140 (both enlarged).
        super().__init__(Backbone(scale, depth), Head(scale), stride=COARSEST // scale, reach=-(-424 // scale))
        self.scale = scale

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input: the head sees no more than it depends on."""
        with self.autocast():
            features = self.backbone(self.entering(x))
            features, row, col = crop(features, row, col, STRIDE // self.scale, REACH)
            logits: Tensor = self.head(features)
        return logits[torch.arange(len(x), device=x.device), 0, row, col].float()
