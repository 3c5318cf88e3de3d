"""A feature pyramid on any backbone of timm that gives feature maps: github.com/huggingface/pytorch-image-models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from see2act.modules.network import Logits, PixelNetwork, check_input, magnified

CHANNELS = 128
"""Channels of the pyramid and of the head."""
FINEST = 4
"""Stride of the finest feature map that is used, and of the head's logits."""
RECEPTIVE_RADIUS = 512
"""Receptive-field radius in pixels. The deepest backbones see further, and transformers see everything, but no heightmap here
is larger."""


class TimmFPN(PixelNetwork):
    """A timm backbone, a feature pyramid and a head like that of an RPN, for RGB-D input.

    Args:
        backbone: A model of ``timm.list_models()`` with feature maps: resnet18, convnext_atto, tf_efficientnet_lite0,
            vit_small_patch14_dinov2, ...
        depth: How the depth enters the network: ``early``, as the fourth channel of the first layer, or ``none``.
        scale: Factor by which the input is enlarged first.

    Raises:
        ValueError: timm is not installed or has no such backbone; the backbone gives no feature maps for inputs of any size;
            or ``depth`` or ``scale`` is unknown.
    """

    def __init__(self, backbone: str = "resnet18", depth: str = "early", scale: int = 1):
        check_input(depth, scale)
        features = Backbone(backbone, depth, scale)
        coarsest, finest = max(features.strides), min(features.strides)
        super().__init__(
            features,
            Head(finest, scale, features.overlap),
            stride=coarsest // math.gcd(coarsest, scale),
            receptive_radius=RECEPTIVE_RADIUS,
        )


class Backbone(nn.Module):
    """RGB-D to the finest level of a feature pyramid, (B, 4, H, W) -> (B, 128, scale H / s, scale W / s).

    Feature j of stride s is centred on the pixel s j if the convolutions overlap (ResNets, EfficientNets), and on the middle
    of the j-th patch of s pixels if they do not (ConvNeXt, transformers). For overlapping convolutions the input is padded by
    one row and one column, so that features are centred like this with TensorFlow's padding too. Their feature maps then
    also have one more row and column.

    Args:
        name: Name of a timm model.
        depth: ``early`` or ``none``.
        scale: Factor by which the input is enlarged first.
    """

    def __init__(self, name: str, depth: str, scale: int):
        super().__init__()
        self._channels_in = 4 if depth == "early" else 3
        self._scale = scale
        self.body, self._channels_last = timm_body(name, self._channels_in)
        used = [i for i, stride in enumerate(self.body.feature_info.reduction()) if stride >= FINEST]
        self._used = used
        self.strides = [self.body.feature_info.reduction()[i] for i in used]
        self.overlap = _overlaps(self.body)
        self.fpn = Pyramid([self.body.feature_info.channels()[i] for i in used], self.overlap)

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 128 h w"]:
        x = magnified(x, self._scale)[:, : self._channels_in]
        features = self.body(F.pad(x, (0, 1, 0, 1), mode="replicate") if self.overlap else x)
        if self._channels_last:
            features = [feature.permute(0, 3, 1, 2) for feature in features]
        merged: Tensor = self.fpn([features[i] for i in self._used])
        return merged


class Pyramid(nn.Module):
    """Sums the feature maps of all levels at the finest one (Lin et al. 2017). In a plain transformer all maps have one size.

    Args:
        channels: Channels of the feature maps, the finest first.
        overlap: Where features are centred; see :class:`Backbone`.
    """

    def __init__(self, channels: Sequence[int], overlap: bool):
        super().__init__()
        self._overlap = overlap
        self.laterals = nn.ModuleList(nn.Conv2d(n, CHANNELS, 1) for n in channels)

    def forward(self, features: Sequence[Float[Tensor, "B c h w"]]) -> Float[Tensor, "B 128 h w"]:
        merged: Tensor | None = None
        for lateral, feature in zip(reversed(self.laterals), reversed(features), strict=True):
            here = lateral(feature)
            merged = here if merged is None else here + resized(merged, here.shape[2:], self._overlap)
        assert merged is not None
        return merged


class Head(nn.Module):
    """Features to one logit per pixel: 3x3 convolutions, with upsampling by two between them until the stride is 4 at most.

    Args:
        stride: Stride of the features.
        scale: Factor by which the input was enlarged; the output is as large as the input before that.
        overlap: Where features are centred; see :class:`Backbone`.
    """

    def __init__(self, stride: float, scale: int, overlap: bool):
        super().__init__()
        self._stride = stride
        self._scale = scale
        self._overlap = overlap
        enlargements = max(0, math.ceil(math.log2(stride / FINEST)))
        self.convolutions = nn.ModuleList(_convolution() for _ in range(enlargements + 1))
        self.logits = Logits(CHANNELS, 1, 1)
        self.logits.start_unsure()

    def forward(self, x: Float[Tensor, "B 128 h w"]) -> Float[Tensor, "B 1 H W"]:
        beyond = int(self._overlap)
        rows, cols = (round((n - beyond) * self._stride) for n in x.shape[2:])
        for k, convolution in enumerate(self.convolutions):
            if k:
                x = resized(x, [2 * n - beyond for n in x.shape[2:]], self._overlap)
            x = convolution(x)
        logits = resized(self.logits(x), [rows + beyond, cols + beyond], self._overlap)[..., :rows, :cols]
        return F.avg_pool2d(logits, self._scale)


def resized(x: Float[Tensor, "B C h w"], size: Sequence[int], overlap: bool) -> Float[Tensor, "B C H W"]:
    """Bilinear resampling that keeps features centred; see :class:`Backbone`."""
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=overlap)


def _convolution() -> nn.Sequential:
    layer = nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1, bias=False)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    return nn.Sequential(layer, nn.BatchNorm2d(CHANNELS), nn.ReLU())


def library() -> Any:
    """The module timm, which is an optional dependency and takes seconds to import.

    Raises:
        ValueError: timm is not installed.
    """
    try:
        return import_module("timm")
    except ImportError:
        raise ValueError("model=timm_fpn needs the package timm: pip install 'see2act[timm]'") from None


def timm_body(name: str, channels_in: int, **weights: object) -> tuple[Any, bool]:
    """A backbone that gives a list of feature maps. Its parameters are random unless ``weights`` says otherwise.

    Args:
        name: Name of a timm model.
        channels_in: Channels of its input.
        weights: Arguments of ``timm.create_model`` that say where pretrained parameters come from.

    Returns:
        The module, whose ``feature_info`` has the strides and channels of the maps; and whether the channels are the last
        dimension of the maps, as in Swin.

    Raises:
        ValueError: As for :class:`TimmFPN`.
    """
    timm = library()
    if not timm.is_model(name):
        near = timm.list_models(f"*{name.split('_')[0]}*")[:5] or ["resnet18", "convnext_atto"]
        raise ValueError(f"model.backbone={name} is unknown to timm {timm.__version__}: choose another, {', '.join(near)}, ...")
    try:
        given = timm.get_pretrained_cfg(name)
    except RuntimeError:
        tags = timm.list_pretrained(f"{name.split('.')[0]}.*")[:4]
        raise ValueError(
            f"timm has no weights of model.backbone={name}: choose {' or '.join(tags) or 'another backbone'}"
        ) from None
    any_size = {"dynamic_img_size": True} if given.fixed_input_size else {}
    build = partial(timm.create_model, name, features_only=True, in_chans=channels_in, **any_size)
    try:
        with torch.device("meta"):
            channels_last = _channels_come_last(build().eval(), channels_in)
    except Exception as error:  # hundreds of models may raise anything
        reason = " ".join(str(error).split())[:120]
        raise ValueError(
            f"model.backbone={name} gives no feature maps of inputs of any size ({type(error).__name__}: {reason}): choose "
            "another, such as resnet18, convnext_atto or vit_small_patch14_dinov2"
        ) from None
    return build(**weights), channels_last


def _overlaps(body: nn.Module) -> bool:
    """Whether the kernel of the first strided convolution is larger than its stride."""
    strided = (layer for layer in body.modules() if isinstance(layer, nn.Conv2d) and layer.stride[0] > 1)
    first = next(strided, None)
    return first is not None and first.kernel_size[0] > first.stride[0]


def _channels_come_last(body: Any, channels_in: int) -> bool:
    """Whether the feature maps of a backbone are (B, h, w, C) instead of (B, C, h, w).

    Raises:
        ValueError: The maps have neither shape.
    """
    strides, channels = body.feature_info.reduction(), body.feature_info.channels()
    rows, cols = 6 * max(strides), 9 * max(strides)
    beyond = int(_overlaps(body))  # Backbone.forward pads these
    shapes = [tuple(feature.shape) for feature in body(torch.empty(1, channels_in, rows + beyond, cols + beyond))]
    for last in (False, True):
        sizes = [shape[1:3] if last else shape[2:] for shape in shapes]
        planes = [shape[3] if last else shape[1] for shape in shapes]
        if planes == channels and all(
            n // stride <= size <= n // stride + beyond
            for pair, stride in zip(sizes, strides, strict=True)
            for size, n in zip(pair, (rows, cols), strict=True)
        ):
            return last
    raise ValueError(f"the last one is {shapes[-1]}, with {channels[-1]} channels and a stride of {strides[-1]}")
