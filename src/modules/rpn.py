"""The network of the real-robot experiments: Detectron's region proposal network on a ResNet with feature pyramid."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
import torchvision
from jaxtyping import Float, Int
from see2act.modules.batchnorm import BatchNorm
from see2act.modules.network import DEPTHS, Logits, PixelNetwork, crop
from torch import Tensor, nn
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.detection.rpn import RPNHead

FPN_CHANNELS = 256
STRIDE = 4
"""Of P2, the pyramid's finest level."""
REACH = 3
"""Features of P2, to each side, that a logit depends on after the pyramid: two convolutions, and an enlargement."""
COARSEST = 32
"""Stride of the coarsest feature map."""


class ResNetFPN(nn.Module):
    """RGB-D to the P2 level of a feature pyramid, (B, 4, H, W) -> (B, 256, H / 4, W / 4).

    ``body`` and ``fpn`` are torchvision's, key by key. The depth enters through ``depth``, a convolution beside the first one
    whose result is added to it: the same as a fourth input channel, with the keys of the other three untouched. It starts
    like the first one; weights that never saw depth make it zero (``copy_parts``).

    Args:
        name: A torchvision ResNet: resnet18, resnet34, resnet50, ...
        depth: ``early`` adds the depth at the first convolution, ``none`` leaves it out.

    Raises:
        ValueError: There is no such ``depth``, or torchvision has no ResNet of this name.
    """

    def __init__(self, name: str, depth: str):
        super().__init__()
        if depth not in DEPTHS:
            raise ValueError(f"model.depth={depth} is unknown: choose one of {', '.join(DEPTHS)}")
        if not name.startswith("resnet") or not hasattr(torchvision.models, name):
            raise ValueError(
                f"model.backbone={name} is unknown: choose one of torchvision's, resnet18, resnet34, resnet50, ..."
            )
        body = getattr(torchvision.models, name)(weights=None, norm_layer=BatchNorm)
        stages = [body.inplanes // 8 * 2**i for i in range(4)]
        pyramid = BackboneWithFPN(body, {f"layer{i + 1}": str(i) for i in range(4)}, stages, FPN_CHANNELS)
        self.body, self.fpn = pyramid.body, pyramid.fpn
        self.depth = nn.Conv2d(1, 64, 7, stride=2, padding=3, bias=False) if depth == "early" else None
        if self.depth is not None:
            nn.init.kaiming_normal_(self.depth.weight, mode="fan_out", nonlinearity="relu")  # as torchvision's ResNets

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        return self.smoothed(self.merged(x))

    def merged(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        """Of the pyramid's finest level, all but its last convolution; of the others, no more than that needs."""
        features = []
        y = x[:, :3]
        for name, layer in self.body.items():
            y = layer(y)
            if name == "conv1" and self.depth is not None:
                y = y + self.depth(x[:, 3:])
            if name in self.body.return_layers:
                features.append(y)
        down: Tensor | None = None
        for block, feature in zip(reversed(self.fpn.inner_blocks), reversed(features), strict=True):
            lateral: Tensor = block(feature)
            down = lateral if down is None else lateral + F.interpolate(down, size=lateral.shape[2:], mode="nearest")
        assert down is not None
        return down

    def smoothed(self, merged: Float[Tensor, "B 256 h w"]) -> Float[Tensor, "B 256 h w"]:
        """P2, from what :meth:`merged` gives."""
        p2: Tensor = self.fpn.layer_blocks[0](merged)
        return p2


class ObjectnessHead(RPNHead):
    """torchvision's RPN head; the objectness of the anchors at a place, max-pooled into one logit and brought to input size.

    ``bbox_pred`` is carried along with the weights and not used.

    Args:
        anchors: Anchors at a place.
    """

    def __init__(self, anchors: int):
        super().__init__(FPN_CHANNELS, anchors)
        logits = Logits(FPN_CHANNELS, anchors, 1)
        logits.load_state_dict(self.cls_logits.state_dict())
        self.cls_logits: nn.Module = logits

    def forward(self, x: Float[Tensor, "B 256 h w"]) -> Float[Tensor, "B 1 H W"]:
        objectness = self.cls_logits(self.conv(x)).amax(1, keepdim=True)
        return enlarged(objectness)


def enlarged(x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C H W"]:
    """Features at every pixel, bilinear between their centres.

    The centre of feature j of a ResNet is pixel ``STRIDE`` j: its convolutions with stride are padded so that the first
    pixel is their first centre. (``align_corners=False`` would take it for ``STRIDE`` j + 1.5.)
    """
    h, w = x.shape[2:]
    x = F.pad(x, (0, 1, 0, 1), mode="replicate")
    return F.interpolate(x, size=(STRIDE * h + 1, STRIDE * w + 1), mode="bilinear", align_corners=True)[..., :-1, :-1]


class RPN(PixelNetwork):
    """Region proposals as a heatmap.

    Args:
        backbone: A torchvision ResNet by name.
        anchors: Anchors at a place (torchvision's detectors: 3).
        depth: How the depth enters: ``early`` or ``none``.
    """

    def __init__(self, backbone: str = "resnet50", anchors: int = 3, depth: str = "early"):
        # The stem, four stages and the pyramid see some 500 px to each side: all of any heightmap here.
        super().__init__(ResNetFPN(backbone, depth), ObjectnessHead(anchors), stride=COARSEST, reach=512)

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input: the widest convolutions, at the end, see no more than it depends on."""
        backbone = cast(ResNetFPN, self.backbone)
        with self.autocast():
            merged = backbone.merged(x.contiguous(memory_format=self._layout))
            merged, row, col = crop(merged, row, col, STRIDE, REACH)
            logits: Tensor = self.head(backbone.smoothed(merged))
        return logits[torch.arange(len(x), device=x.device), 0, row, col].float()
