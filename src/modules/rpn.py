"""The network of the real-robot experiments: a region proposal network on a backbone with feature pyramid."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
import torchvision
from jaxtyping import Float, Int
from torch import Tensor, nn
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.detection.rpn import RPNHead

from see2act.modules.batchnorm import BatchNorm
from see2act.modules.network import Count, Logits, PixelNetwork, check_input, crop

FPN_CHANNELS = 256
REACH = 3
"""Features of the pyramid's finest level, to each side, that a logit depends on after it: two convolutions, an enlargement."""
COARSEST = 32
"""Stride of the coarsest feature map."""
MOBILENET = "mobilenet_v3_large"


class DetectorBackbone(nn.Module):
    """RGB-D to the finest level of a feature pyramid, (B, 4, H, W) -> (B, 256, H / stride, W / stride).

    ``body`` and ``fpn`` are torchvision's, key by key. The depth enters through ``depth``, a convolution beside the first one
    whose result is added to it: the same as a fourth input channel, with the keys of the other three untouched. It starts
    like the first one; weights that never saw depth make it zero (``copy_parts``).

    Args:
        name: resnet18, resnet34, resnet50, ..., or mobilenet_v3_large.
        depth: ``early`` adds the depth at the first convolution, ``none`` leaves it out.

    Raises:
        ValueError: There is no such ``depth``, or no such backbone.
    """

    def __init__(self, name: str, depth: str):
        super().__init__()
        check_input(depth)
        if name == MOBILENET:
            self.stride, self.anchors, pyramid = 32, 15, _mobilenet()
        elif name.startswith("resnet") and name in torchvision.models.list_models():
            self.stride, self.anchors, pyramid = 4, 3, _resnet(name)
        else:
            raise ValueError(f"model.backbone={name} is unknown: choose one of resnet18, resnet34, resnet50, ..., {MOBILENET}")
        self.body, self.fpn = pyramid.body, pyramid.fpn
        first = next(layer for layer in self.body.modules() if isinstance(layer, nn.Conv2d))
        size, stride, padding = (int(n[0]) for n in (first.kernel_size, first.stride, first.padding))
        self.depth = nn.Conv2d(1, first.out_channels, size, stride, padding, bias=False) if depth == "early" else None
        if self.depth is not None:
            nn.init.kaiming_normal_(self.depth.weight, mode="fan_out", nonlinearity="relu")  # as torchvision's

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        return self.smoothed(self.merged(x))

    def merged(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        """Of the pyramid's finest level, all but its last convolution; of the others, no more than that needs."""
        features = []
        (_, first), *others = self.body.items()
        convolution, *rest = first if isinstance(first, nn.Sequential) else [first]
        y = convolution(x[:, :3])
        if self.depth is not None:
            y = y + self.depth(x[:, 3:])
        for layer in rest:
            y = layer(y)
        for name, layer in others:
            y = layer(y)
            if name in self.body.return_layers:
                features.append(y)
        down: Tensor | None = None
        for block, feature in zip(reversed(self.fpn.inner_blocks), reversed(features), strict=True):
            lateral: Tensor = block(feature)
            down = lateral if down is None else lateral + F.interpolate(down, size=lateral.shape[2:], mode="nearest")
        assert down is not None
        return down

    def smoothed(self, merged: Float[Tensor, "B 256 h w"]) -> Float[Tensor, "B 256 h w"]:
        """The finest level, from what :meth:`merged` gives."""
        finest: Tensor = self.fpn.layer_blocks[0](merged)
        return finest


def _resnet(name: str) -> BackboneWithFPN:
    """All four stages, as in torchvision's detectors."""
    body = getattr(torchvision.models, name)(weights=None, norm_layer=BatchNorm)
    stages = [body.inplanes // 8 * 2**i for i in range(4)]
    return BackboneWithFPN(body, {f"layer{i + 1}": str(i) for i in range(4)}, stages, FPN_CHANNELS)


def _mobilenet() -> BackboneWithFPN:
    """The last two stages, both of stride 32, as in ``fasterrcnn_mobilenet_v3_large_fpn``."""
    body = torchvision.models.mobilenet_v3_large(weights=None, norm_layer=BatchNorm).features
    return BackboneWithFPN(body, {"13": "0", "16": "1"}, [160, 960], FPN_CHANNELS)


class ObjectnessHead(RPNHead):
    """torchvision's RPN head; the objectness of the anchors at a place, max-pooled into one logit and brought to input size.

    ``bbox_pred`` is carried along with the weights and not used.

    Args:
        anchors: Anchors at a place.
        stride: Of the features.
    """

    def __init__(self, anchors: int, stride: int):
        super().__init__(FPN_CHANNELS, anchors)
        logits = Logits(FPN_CHANNELS, anchors, 1)
        logits.load_state_dict(self.cls_logits.state_dict())
        self.cls_logits: nn.Module = logits
        self._stride = stride

    def forward(self, x: Float[Tensor, "B 256 h w"]) -> Float[Tensor, "B 1 H W"]:
        objectness = self.cls_logits(self.conv(x)).amax(1, keepdim=True)
        return enlarged(objectness, self._stride)


def enlarged(x: Float[Tensor, "B C h w"], stride: int) -> Float[Tensor, "B C H W"]:
    """Features at every pixel, bilinear between their centres.

    The centre of feature j is pixel ``stride`` j: convolutions with stride are padded so that the first pixel is their
    first centre. (``align_corners=False`` would take it for ``stride`` (j + 0.5) - 0.5.)
    """
    h, w = x.shape[2:]
    x = F.pad(x, (0, 1, 0, 1), mode="replicate")
    return F.interpolate(x, size=(stride * h + 1, stride * w + 1), mode="bilinear", align_corners=True)[..., :-1, :-1]


class RPN(PixelNetwork):
    """Region proposals as a heatmap.

    Args:
        backbone: A torchvision ResNet by name, or mobilenet_v3_large.
        anchors: Anchors at a place; None: as torchvision's detector of this backbone has, 3 or 15.
        depth: How the depth enters: ``early`` or ``none``.
    """

    def __init__(self, backbone: str = "resnet50", anchors: Count | None = None, depth: str = "early"):
        # The stem, four stages and the pyramid see some 500 px to each side: all of any heightmap here.
        features = DetectorBackbone(backbone, depth)
        head = ObjectnessHead(anchors or features.anchors, features.stride)
        super().__init__(features, head, stride=COARSEST, reach=512)

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input: the widest convolutions, at the end, see no more than it depends on."""
        backbone = cast(DetectorBackbone, self.backbone)
        with self.autocast():
            merged = backbone.merged(self.entering(x))
            merged, row, col = crop(merged, row, col, backbone.stride, REACH)
            logits: Tensor = self.head(backbone.smoothed(merged))
        return logits[torch.arange(len(x), device=x.device), 0, row, col].float()
