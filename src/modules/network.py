"""The architecture that vision and affordance models share: normalisation, backbone, head."""

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
"""How the depth can enter networks that others trained on RGB: at the first convolution, or not at all."""
SCALES = (1, 2, 4)
"""Factors by which networks with a coarse stride can enlarge their input."""
TOGETHER = {"fp32": 2, "bf16": 4}
"""Heightmaps per forward pass on a CPU, by precision. More of them would no longer fit into its cache."""


class Normalization(nn.Module):
    """Statistics of the four input channels (R, G, B in 0..1, height in metres).

    They belong to the source model, are saved in its checkpoint, and are copied by every transfer. ``mean`` and ``std`` (4,)
    are those of the model's training data. ``average`` (4,) is the average pixel of heightmaps, which fills the space beyond
    their border. ``average`` differs from ``mean`` only for weights that others trained on photographs: around a rotated
    heightmap, the mean of photographs would look like an edge.
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
        """Set statistics that were measured on heightmaps."""
        self.mean.copy_(mean)
        self.std.copy_(std)
        self.average.copy_(mean)

    def centred(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """Input scaled by ``std`` and shifted so that the average pixel is zero."""
        return (x - self.average[:, None, None]) / self.std[:, None, None]

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """Convert the output of :meth:`centred` to the normalisation of the training data, where ``mean`` is zero."""
        return x + ((self.average - self.mean) / self.std)[:, None, None]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        # Models from before ``average`` existed were trained on heightmaps, so their mean is the average.
        if f"{prefix}mean" in state_dict:
            state_dict.setdefault(f"{prefix}average", state_dict[f"{prefix}mean"])
        super()._load_from_state_dict(state_dict, prefix, *others)


class PixelNetwork(nn.Module):
    """RGB-D heightmap in, one logit per pixel out.

    A subclass or the caller provides ``backbone``, (B, 4, H, W) -> features, and ``head``, features -> (B, 1, H, W).
    A transfer can copy only what is in one of these two.

    Args:
        backbone: Feature extractor.
        head: Prediction layers, a :class:`Logits` among them.
        stride: The sides of the input are padded to multiples of this, pixels.
        receptive_radius: Receptive-field radius of a logit, pixels.
    """

    def __init__(self, backbone: nn.Module, head: nn.Module, stride: int, receptive_radius: int):
        super().__init__()
        self.normalization = Normalization()
        self.backbone = backbone
        self.head = head
        self.stride = stride
        self.receptive_radius = receptive_radius
        self._precision = "fp32"
        self._layout = torch.contiguous_format

    def set_precision(self, precision: str) -> None:
        """Set the precision of computation, and use the memory layout in which convolutions are fastest on a CPU.

        Args:
            precision: ``fp32``, or ``bf16`` for bfloat16 except in the logits. Parameters stay in single precision.

        Raises:
            ValueError: ``precision`` is unknown.
        """
        if precision not in PRECISIONS:
            raise ValueError(f"precision={precision} is unknown: choose one of {', '.join(PRECISIONS)}")
        self._precision = precision
        self._layout = torch.channels_last
        self.to(memory_format=self._layout)

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return self.normalization.mean.device

    @property
    def together(self) -> int:
        """Heightmaps per forward pass: the fastest number on a CPU, or 16 (all rotations of a heightmap) on an accelerator."""
        return TOGETHER[self._precision] if self.device.type == "cpu" else 16

    def prepare(self, color: UInt8[Tensor, "B H W 3"], height: Float[Tensor, "B H W"]) -> Float[Tensor, "B 4 H W"]:
        """Network input before rotation, cropping and padding. Padding with zeros looks like average pixels."""
        rgb = color.permute(0, 3, 1, 2).to(height.dtype) / 255
        return self.normalization.centred(torch.cat([rgb, height[:, None]], dim=1))

    @torch.no_grad()
    def scale_logits(self, factor: float) -> None:
        """Scale all logits (temperature scaling, Guo et al. 2017). A factor below 1 makes predictions less confident and keeps
        their order."""
        for layer in self.head.modules():
            if isinstance(layer, Logits):
                for parameter in layer.parameters():
                    parameter.mul_(factor)

    def autocast(self) -> torch.autocast:
        """A context that computes in the chosen precision."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._precision == "bf16")

    def entering(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
        """Prepared input, normalised and laid out for the backbone."""
        normalized: Tensor = self.normalization(x)
        return normalized.contiguous(memory_format=self._layout)

    def forward(self, x: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 1 H W"]:
        """Logits of prepared input of any size."""
        rows, cols = x.shape[2:]
        x = F.pad(x, (0, -cols % self.stride, 0, -rows % self.stride))
        with self.autocast():
            logits: Tensor = self.head(self.backbone(self.entering(x)))
        return logits[..., :rows, :cols].float()

    @torch.no_grad()
    def scores(self, color: UInt8[np.ndarray, "n H W 3"], height: Float[np.ndarray, "n H W"]) -> Float[np.ndarray, "n H W"]:
        """Probabilities for every pixel of many heightmaps, with fixed BatchNorm statistics."""
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
    """Check ``model.depth`` and ``model.scale``.

    Raises:
        ValueError: One of them is unknown. The message names the configuration key.
    """
    if scale not in SCALES:
        raise ValueError(f"model.scale={scale} is unknown: choose one of {', '.join(map(str, SCALES))}")
    if depth not in DEPTHS:
        raise ValueError(f"model.depth={depth} is unknown: choose one of {', '.join(DEPTHS)}")


class Logits(nn.Conv2d):
    """The last convolution, computed in the precision of its parameters. In bfloat16 many large logits would be equal, and the
    argmax would pick the upper left one of them."""

    def start_unsure(self) -> None:
        """Initialise so that every pixel has a probability of about 0.5 and all outputs are nearly equal."""
        nn.init.normal_(self.weight, std=0.01)
        assert self.bias is not None
        nn.init.zeros_(self.bias)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B K H W"]:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


def magnified(x: Float[Tensor, "B C h w"], scale: int) -> Float[Tensor, "B C H W"]:
    """Input enlarged bicubically by one of ``SCALES``."""
    return x if scale == 1 else F.interpolate(x, scale_factor=float(scale), mode="bicubic", align_corners=False)


def crop(
    x: Float[Tensor, "B C h w"], row: Int[Tensor, " B"], col: Int[Tensor, " B"], stride: int, radius: int
) -> tuple[Float[Tensor, "B C k k"], Int[Tensor, " B"], Int[Tensor, " B"]]:
    """The part of each feature map within ``radius`` of a pixel; at a border the part is moved to stay on the map.

    Args:
        x: Features.
        row, col: The pixels, at full resolution.
        stride: Stride of the features.
        radius: Number of features to each side.

    Returns:
        The parts, and the row and column of each pixel in its part, at full resolution.
    """
    size = [min(2 * radius + 1, n) for n in x.shape[2:]]
    top, left = ((at // stride - radius).clamp(0, n - k) for at, n, k in zip((row, col), x.shape[2:], size, strict=True))
    parts = [
        x[i, :, t : t + size[0], k : k + size[1]] for i, (t, k) in enumerate(zip(top.tolist(), left.tolist(), strict=True))
    ]
    layout = torch.channels_last if x.is_contiguous(memory_format=torch.channels_last) else torch.contiguous_format
    return torch.stack(parts).contiguous(memory_format=layout), row - top * stride, col - left * stride
