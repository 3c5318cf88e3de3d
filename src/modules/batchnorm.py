"""BatchNorm: estimating its statistics without labels, and freezing it."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn


class BatchNorm(nn.BatchNorm2d):
    """BatchNorm with its epsilon in the state dict. Torchvision's COCO detectors need 0, its ImageNet models 1e-5."""

    epsilon: Tensor

    def __init__(self, channels: int):
        super().__init__(channels)
        self.register_buffer("epsilon", torch.tensor(self.eps))
        self._read: tuple[Tensor, int] | None = None

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        # Reading a number from an accelerator waits for all pending work, so epsilon is read only when it may have changed.
        now = self.epsilon, self.epsilon._version
        if self._read is None or self._read[0] is not now[0] or self._read[1] != now[1]:
            self.eps, self._read = float(self.epsilon), now
        return super().forward(x)


def batchnorms(network: nn.Module) -> dict[str, nn.BatchNorm2d]:
    """All BatchNorm layers, by name in the network."""
    return {name: m for name, m in network.named_modules() if isinstance(m, nn.BatchNorm2d)}


def epsilons(network: nn.Module) -> list[Tensor]:
    """Epsilons of all layers of type :class:`BatchNorm`."""
    return [layer.epsilon for layer in batchnorms(network).values() if isinstance(layer, BatchNorm)]


def freeze(network: nn.Module) -> None:
    """Use the running statistics without updating them, whatever the mode of the rest of the network."""
    for layer in batchnorms(network).values():
        layer.eval()


@torch.no_grad()
def estimate(network: nn.Module, inputs: Iterable[Tensor], layers: Iterable[str]) -> None:
    """Set the running statistics of some layers to those of unlabelled inputs.

    A newly initialised layer has mean 0 and variance 1, which normalises nothing. A network that is frozen in this state
    works badly. Only the named layers change; the others keep the statistics that came with their weights.

    Args:
        network: May be in any mode; the mode is kept.
        inputs: Batches of prepared input (B, 4, H, W).
        layers: Names as in :func:`batchnorms`.
    """
    chosen = [batchnorms(network)[name] for name in layers]
    if not chosen:
        return
    training = network.training
    network.eval()
    momenta = [layer.momentum for layer in chosen]
    for layer in chosen:
        layer.reset_running_stats()
        layer.momentum = None  # a plain average over all batches
        layer.train()
    for x in inputs:
        network(x)
    for layer, momentum in zip(chosen, momenta, strict=True):
        layer.momentum = momentum
    network.train(training)
