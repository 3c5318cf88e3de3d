"""The architecture that vision and affordance models share: normalise, backbone, head."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
import torch.nn.functional as F
from annotated_types import Ge
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

Count = Annotated[int, Ge(1)]
PRECISIONS = ("fp32", "bf16")
DEPTHS = ("early", "none")
"""How the depth may enter networks that others trained on RGB: at the first convolution, or not at all."""
SCALES = (1, 2, 4)
"""By how much networks of a coarse stride may enlarge their input."""
TOGETHER = {"fp32": 2, "bf16": 4}
"""Heightmaps that go through a network at once on a processor: more of them no longer fit its cache."""


class Normalization(nn.Module):
    """Statistics of the four input channels (R, G, B in 0..1, height in metres).

    They belong to the source model, are saved in its checkpoint and carried along by every transfer. ``mean`` and ``std``
    (4,) are of the data that it learned from. ``average`` (4,) is of heightmaps: the pixel that stands for whatever is
    beyond one's border. They differ only in weights that others trained on photographs, to which the mean of those, laid
    around a turned heightmap, would be an edge.
    """

    mean: Tensor
    std: Tensor
    average: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(4))
        self.register_buffer("std", torch.ones(4))
        self.register_buffer("average", torch.zeros(4))

    def set(self, mean: Float[Tensor, "4"], std: Float[Tensor, "4"]) -> None:
        """Take over statistics that were measured on heightmaps."""
        self.mean.copy_(mean)
        self.std.copy_(std)
        self.average.copy_(mean)

    def centred(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """In the network's units, and zero where a pixel is average."""
        return (x - self.average[:, None, None]) / self.std[:, None, None]

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """From :meth:`centred` to what the network learned to see: zero where a pixel is the mean."""
        return x + ((self.average - self.mean) / self.std)[:, None, None]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        # Models that were saved before there was an average learned from heightmaps.
        if f"{prefix}mean" in state_dict:
            state_dict.setdefault(f"{prefix}average", state_dict[f"{prefix}mean"])
        super()._load_from_state_dict(state_dict, prefix, *others)


class PixelNetwork(nn.Module):
    """RGB-D heightmap in, one logit a pixel out.

    A subclass, or whoever builds one, provides ``backbone`` (B, 4, H, W) -> features and ``head`` features ->
    (B, 1, H, W). Everything a transfer can copy lives under one of those two names.

    Args:
        backbone: Feature extractor.
        head: Prediction layers, a :class:`Logits` among them.
        stride: Input sides are padded to multiples of this.
        reach: Pixels around a logit that can influence it, on each side.
    """

    def __init__(self, backbone: nn.Module, head: nn.Module, stride: int, reach: int):
        super().__init__()
        self.normalization = Normalization()
        self.backbone = backbone
        self.head = head
        self.stride = stride
        self.reach = reach
        self._precision = "fp32"
        self._layout = torch.contiguous_format

    def set_precision(self, precision: str) -> None:
        """Lay weights and inputs out as convolutions on a CPU like them best, and choose what they compute in.

        Args:
            precision: ``fp32``, or ``bf16`` for bfloat16 in all but the logits; parameters stay in single precision.

        Raises:
            ValueError: There is no such precision.
        """
        if precision not in PRECISIONS:
            raise ValueError(f"precision={precision} is unknown: choose one of {', '.join(PRECISIONS)}")
        self._precision = precision
        self._layout = torch.channels_last
        self.to(memory_format=self._layout)

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self.normalization.mean.device

    @property
    def together(self) -> int:
        """Heightmaps that go through it at once: as many as it computes fastest, and all that there are on an accelerator."""
        return TOGETHER[self._precision] if self.device.type == "cpu" else 16

    def prepare(self, color: UInt8[Tensor, "B H W 3"], height: Float[Tensor, "B H W"]) -> Float[Tensor, "B 4 H W"]:
        """What is turned, cut and padded before the network sees it; zero is the average pixel, which padding looks like."""
        rgb = color.permute(0, 3, 1, 2).to(height.dtype) / 255
        return self.normalization.centred(torch.cat([rgb, height[:, None]], dim=1))

    @torch.no_grad()
    def scale_logits(self, factor: float) -> None:
        """Make predictions less sure (a factor below 1), the best staying the best: temperature scaling (Guo et al. 2017)."""
        for layer in self.head.modules():
            if isinstance(layer, Logits):
                for parameter in layer.parameters():
                    parameter.mul_(factor)

    def autocast(self) -> torch.autocast:
        """Computes in the precision that was chosen."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._precision == "bf16")

    def entering(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """Prepared input as the backbone takes it."""
        normalized: Tensor = self.normalization(x)
        return normalized.contiguous(memory_format=self._layout)

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 1 H W"]:
        """Logits of prepared input, which may be of any size."""
        rows, cols = x.shape[2:]
        x = F.pad(x, (0, -cols % self.stride, 0, -rows % self.stride))
        with self.autocast():
            logits: Tensor = self.head(self.backbone(self.entering(x)))
        return logits[..., :rows, :cols].float()

    @torch.no_grad()
    def scores(self, color: UInt8[np.ndarray, "n H W 3"], height: Float[np.ndarray, "n H W"]) -> Float[np.ndarray, "n H W"]:
        """Probabilities for every pixel of many heightmaps, with fixed statistics."""
        training = self.training
        self.eval()
        parts = zip(*(torch.from_numpy(array).split(self.together) for array in (color, height)), strict=True)
        maps = [torch.sigmoid(self(self.prepare(*(array.to(self.device) for array in part))))[:, 0].cpu() for part in parts]
        self.train(training)
        return torch.cat(maps).numpy()

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input."""
        logits: Tensor = self(x)[torch.arange(len(x), device=x.device), 0, row, col]
        return logits


def check_input(depth: str, scale: int = 1) -> None:
    """Refuse a way for the depth to enter, or an enlargement, that no network has.

    Raises:
        ValueError: With the key of the configuration.
    """
    if scale not in SCALES:
        raise ValueError(f"model.scale={scale} is unknown: choose one of {', '.join(map(str, SCALES))}")
    if depth not in DEPTHS:
        raise ValueError(f"model.depth={depth} is unknown: choose one of {', '.join(DEPTHS)}")


class Logits(nn.Conv2d):
    """The last convolution, in its parameters' precision: in bfloat16 large logits are equal, and ties go to the upper left."""

    def start_unsure(self) -> None:
        """Begin near "I do not know": every pixel has a probability of about a half, and its outputs are nearly alike."""
        nn.init.normal_(self.weight, std=0.01)
        assert self.bias is not None
        nn.init.zeros_(self.bias)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B K H W"]:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


def magnified(x: Float[Tensor, "B C h w"], scale: int) -> Float[Tensor, "B C H W"]:
    """Input enlarged by one of ``SCALES``, bicubic."""
    return x if scale == 1 else F.interpolate(x, scale_factor=float(scale), mode="bicubic", align_corners=False)


def crop(
    x: Float[Tensor, "B C h w"], row: Int[Tensor, " B"], col: Int[Tensor, " B"], stride: int, reach: int
) -> tuple[Float[Tensor, "B C k k"], Int[Tensor, " B"], Int[Tensor, " B"]]:
    """The part of each feature map that lies within ``reach`` of a pixel, and never beyond the map.

    Args:
        x: Features.
        row, col: The pixels, counted at full resolution.
        stride: Of the features.
        reach: In features, to each side.

    Returns:
        The parts, and each pixel's row and column in its part, at full resolution.
    """
    size = [min(2 * reach + 1, n) for n in x.shape[2:]]
    top, left = ((at // stride - reach).clamp(0, n - k) for at, n, k in zip((row, col), x.shape[2:], size, strict=True))
    parts = [
        x[i, :, t : t + size[0], k : k + size[1]] for i, (t, k) in enumerate(zip(top.tolist(), left.tolist(), strict=True))
    ]
    layout = torch.channels_last if x.is_contiguous(memory_format=torch.channels_last) else torch.contiguous_format
    return torch.stack(parts).contiguous(memory_format=layout), row - top * stride, col - left * stride
