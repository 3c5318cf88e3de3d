"""An affordance module with settings that a test does not care about."""

from __future__ import annotations

from typing import Any

from see2act.modules.affordance import AffordanceModule
from see2act.modules.network import PixelNetwork


def make_module(network: PixelNetwork, shape: tuple[int, int] = (144, 144), angles: int = 1, **more: Any) -> AffordanceModule:
    settings = {
        "backbone_lr": 1e-4,
        "head_lr": 1e-4,
        "lr_warmup": 0,
        "weight_decay": 0.0,
        "batchnorm": "frozen",
        "averaging": 0.9,
        "averaging_warmup": 0,
    }
    return AffordanceModule(network, shape=shape, angles=angles, **(settings | more))
