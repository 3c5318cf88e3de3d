"""The network of the paper's simulation experiments: TossingBot's 7-layer residual FCN (Zeng et al. 2019)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from see2act.modules.network import Count, Logits, PixelNetwork, crop


class Residual(nn.Module):
    """Two 3x3 convolutions and a shortcut, (B, in, H, W) -> (B, out, H, W)."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels_in, channels_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(channels_out),
            nn.ReLU(),
            nn.Conv2d(channels_out, channels_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(channels_out),
        )
        self.shortcut = nn.Conv2d(channels_in, channels_out, 1, bias=False)
        self.activation = nn.ReLU()

    def forward(self, x: Float[Tensor, "B c H W"]) -> Float[Tensor, "B d H W"]:
        y: Tensor = self.activation(self.body(x) + self.shortcut(x))
        return y


class FCN7(PixelNetwork):
    """A backbone of seven 3x3 convolutions with stride 4, and a head that upsamples its features to a heatmap.

    Args:
        width: Channels of the first layer; the paper's network has 64.
    """

    def __init__(self, width: Count = 16):
        backbone = nn.Sequential(
            nn.Conv2d(4, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            nn.MaxPool2d(2),
            Residual(width, 2 * width),
            nn.MaxPool2d(2),
            Residual(2 * width, 4 * width),
            Residual(4 * width, 8 * width),
        )
        head = nn.Sequential(
            Residual(8 * width, 4 * width),
            Residual(4 * width, 2 * width),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            Residual(2 * width, width),
            Logits(width, 1, 1),  # before the last upsampling: the result is the same, and only one channel is upsampled
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
        )
        super().__init__(backbone, head, stride=4, receptive_radius=48)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        last = head[-2]
        assert isinstance(last, Logits)
        last.start_unsure()

    def logits_at(self, x: Float[Tensor, "B 4 H W"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> Float[Tensor, " B"]:
        """The logit of one pixel of each input, with fixed BatchNorm statistics. Each block runs only on what it depends on.

        A window that ends at an edge of the input ends there in every layer, so the padding is the same.
        """
        x = self.entering(x)
        stride, coarsest = 1, False
        with self.autocast():
            for layer, radius in self._radii():
                coarsest |= stride == self.stride
                if coarsest and isinstance(layer, Residual):  # an earlier crop would change which pixels are pooled
                    x, row, col = crop(x, row, col, stride, radius)
                x = layer(x)
                stride = {nn.MaxPool2d: stride * 2, nn.Upsample: stride // 2}.get(type(layer), stride)
        return x[torch.arange(len(x), device=x.device), 0, row, col].float()

    def _radii(self) -> list[tuple[nn.Module, int]]:
        """Every layer, with the receptive-field radius of a logit in that layer's input."""
        radii, radius = [], 0
        for layer in reversed([*self.backbone.children(), *self.head.children()]):
            match layer:
                case Residual():
                    radius += 2
                case nn.Conv2d(kernel_size=(3, 3)):
                    radius += 1
                case nn.MaxPool2d():
                    radius = 2 * radius + 1
                case nn.Upsample():
                    radius = (radius + 1) // 2 + 1
            radii.append((layer, radius))
        return radii[::-1]
