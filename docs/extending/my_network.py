"""A network: five plain convolutions, dilated to see further."""

from torch import nn

from see2act.modules.network import Logits, PixelNetwork


class Dilated(PixelNetwork):
    """Backbone and head at full resolution. A logit depends on 1 + 2 + 4 + 8 + 1 pixels to each side.

    Args:
        width: Channels of every layer.
    """

    def __init__(self, width: int):
        channels, layers = 4, []
        for dilation in (1, 2, 4, 8):
            layers += [
                nn.Conv2d(channels, width, 3, padding=dilation, dilation=dilation, bias=False),
                nn.BatchNorm2d(width),
                nn.ReLU(),
            ]
            channels = width
        head = nn.Sequential(nn.Conv2d(width, width, 3, padding=1), nn.ReLU(), Logits(width, 1, 1))
        super().__init__(nn.Sequential(*layers), head, stride=1, receptive_radius=16)
