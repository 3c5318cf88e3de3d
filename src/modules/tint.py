"""Other colours for the same shapes."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def tints(count: int, amount: float, generator: torch.Generator) -> Float[Tensor, "B 3 4"]:
    """Random mixtures for :func:`tinted`: channels in any order, up to ``amount`` stronger or weaker, lighter or darker.

    With an ``amount`` of 0 colours stay as they are.
    """
    mixtures = torch.eye(3, 4).repeat(count, 1, 1)
    if amount:
        order = torch.rand(count, 3, generator=generator).argsort(1)
        strength = 1 + amount * (2 * torch.rand(count, 3, 1, generator=generator) - 1)
        mixtures[:, :, :3] = torch.eye(3)[order] * strength
        mixtures[:, :, 3] = amount * (torch.rand(count, 3, generator=generator) - 0.5)
    return mixtures


def tinted(color: UInt8[Tensor, "B H W 3"], mixtures: Float[Tensor, "B 3 4"]) -> UInt8[Tensor, "B H W 3"]:
    """Each channel a mixture of all: three shares of R, G and B, and one of white."""
    mixed = torch.einsum("bhwc,bkc->bhwk", color.float(), mixtures[:, :, :3]) + 255 * mixtures[:, None, None, :, 3]
    return mixed.round().clamp(0, 255).to(torch.uint8)
