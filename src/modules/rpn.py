"""The network of the paper's real-robot experiments: a region proposal network on a backbone with a feature pyramid."""

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
RADIUS = 3
"""Receptive-field radius of a logit after the pyramid, in features of the finest level: two convolutions and an upsampling."""
COARSEST = 32
"""Stride of the coarsest feature map."""
MOBILENET = "mobilenet_v3_large"


class DetectorBackbone(nn.Module):
    """RGB-D to the finest level of a feature pyramid, (B, 4, H, W) -> (B, 256, H / stride, W / stride).

    ``body`` and ``fpn`` have the same keys as in torchvision. The depth enters through a separate convolution, ``depth``, whose
    output is added to that of the first one. This equals a fourth input channel, but leaves the keys of the other three as
    they are. It is initialised like the first one, and set to zero for weights that never saw depth (``copy_parts``).

    Args:
        name: resnet18, resnet34, resnet50, ..., or mobilenet_v3_large.
        depth: ``early`` adds the depth at the first convolution; ``none`` leaves it out.

    Raises:
        ValueError: ``depth`` or the backbone is unknown.
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
            nn.init.kaiming_normal_(self.depth.weight, mode="fan_out", nonlinearity="relu")  # as in torchvision

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        return self.smoothed(self.merged(x))

    def merged(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 256 h w"]:
        """The pyramid's finest level before its last convolution. Of the other levels, only what this needs is computed."""
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
        """The last convolution of the finest level, applied to the output of :meth:`merged`."""
        finest: Tensor = self.fpn.layer_blocks[0](merged)
        return finest


def _resnet(name: str) -> BackboneWithFPN:
    """A pyramid on all four stages, as in torchvision's detectors."""
    body = getattr(torchvision.models, name)(weights=None, norm_layer=BatchNorm)
    stages = [body.inplanes // 8 * 2**i for i in range(4)]
    return BackboneWithFPN(body, {f"layer{i + 1}": str(i) for i in range(4)}, stages, FPN_CHANNELS)


def _mobilenet() -> BackboneWithFPN:
    """A pyramid on the last two stages, both of stride 32, as in ``fasterrcnn_mobilenet_v3_large_fpn``."""
    body = torchvision.models.mobilenet_v3_large(weights=None, norm_layer=BatchNorm).features
    return BackboneWithFPN(body, {"13": "0", "16": "1"}, [160, 960], FPN_CHANNELS)


class ObjectnessHead(RPNHead):
    """torchvision's RPN head. The objectness of all anchors at a location is max-pooled into one logit and upsampled.

    ``bbox_pred`` is kept, so that weights can be loaded, but not used.

    Args:
        anchors: Number of anchors per location.
        stride: Stride of the features.
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
    """Upsample features to pixels, bilinearly between the features' centres.

    Feature j is centred on the pixel ``stride`` j, because strided convolutions are padded so that their first centre is the
    first pixel. (With ``align_corners=False`` it would be ``stride`` (j + 0.5) - 0.5.)
    """
    h, w = x.shape[2:]
    x = F.pad(x, (0, 1, 0, 1), mode="replicate")
    return F.interpolate(x, size=(stride * h + 1, stride * w + 1), mode="bilinear", align_corners=True)[..., :-1, :-1]


class RPN(PixelNetwork):
    """A region proposal network whose objectness is the heatmap.

    Args:
        backbone: Name of a torchvision ResNet, or mobilenet_v3_large.
        anchors: Number of anchors per location; None for that of torchvision's detector with this backbone, 3 or 15.
        depth: How the depth enters the network: ``early`` or ``none``.
    """

    def __init__(self, backbone: str = "resnet50", anchors: Count | None = None, depth: str = "early"):
        # The stem, four stages and the pyramid see about 500 px to each side, which covers every heightmap here.
        features = DetectorBackbone(backbone, depth)
        head = ObjectnessHead(anchors or features.anchors, features.stride)
        super().__init__(features, head, stride=COARSEST, receptive_radius=512)

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input. The widest convolutions, at the end, run only on what the logit depends on."""
        backbone = cast(DetectorBackbone, self.backbone)
        with self.autocast():
            merged = backbone.merged(self.entering(x))
            merged, row, col = crop(merged, row, col, backbone.stride, RADIUS)
            logits: Tensor = self.head(backbone.smoothed(merged))
        return logits[torch.arange(len(x), device=x.device), 0, row, col].float()
