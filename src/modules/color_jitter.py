"""Colour jitter: the same shapes in other colours."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def random_mixtures(count: int, strength: float, generator: torch.Generator) -> Float[Tensor, "B 3 4"]:
    """Random mixtures of channels for :func:`mixed`. The channels are shuffled, scaled by 1 +- ``strength`` at most, and
    brightened or darkened by ``strength`` / 2 of white at most.

    A ``strength`` of 0 leaves colours as they are, and draws nothing from the generator.
    """
    mixtures = torch.eye(3, 4).repeat(count, 1, 1)
    if strength:
        order = torch.rand(count, 3, generator=generator).argsort(1)
        gain = 1 + strength * (2 * torch.rand(count, 3, 1, generator=generator) - 1)
        mixtures[:, :, :3] = torch.eye(3)[order] * gain
        mixtures[:, :, 3] = strength * (torch.rand(count, 3, generator=generator) - 0.5)
    return mixtures


def mixed(color: UInt8[Tensor, "B H W 3"], mixtures: Float[Tensor, "B 3 4"]) -> UInt8[Tensor, "B H W 3"]:
    """Mix channels: each output channel is a weighted sum of R, G, B and white (255)."""
    weighted = torch.einsum("bhwc,bkc->bhwk", color.float(), mixtures[:, :, :3]) + 255 * mixtures[:, None, None, :, 3]
    return weighted.round().clamp(0, 255).to(torch.uint8)
