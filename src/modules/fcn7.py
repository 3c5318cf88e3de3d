"""The network of the simulation experiments: TossingBot's 7-layer residual FCN (Zeng et al. 2019)."""

from __future__ import annotations

from jaxtyping import Float
from see2act.modules.network import PixelNetwork
from torch import Tensor, nn


class Residual(nn.Module):
    """Two 3x3 convolutions and a shortcut; the resolution stays, (B, in, H, W) -> (B, out, H, W)."""

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
    """Backbone of seven 3x3 convolutions at stride 4, and the head that brings its features back to a heatmap.

    Args:
        width: Channels of the first layer; the paper's network has 64.
    """

    def __init__(self, width: int = 16):
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
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            nn.Conv2d(width, 1, 1),
        )
        super().__init__(backbone, head, stride=4, reach=48)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        # Start near "I do not know": every pixel of a new head has a probability of about a half.
        last = head[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.normal_(last.weight, std=0.01)
        nn.init.zeros_(last.bias)
