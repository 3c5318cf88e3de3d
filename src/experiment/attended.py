"""Robots whose bin a person fills."""

from __future__ import annotations

from hydra.utils import get_object
from omegaconf import DictConfig


def attended(cfg: DictConfig) -> bool:
    """Whether a person fills the bin of the configured robot; see :class:`see2act.robot.robot.Robot`."""
    try:
        return bool(getattr(get_object(str(cfg.robot.get("_target_"))), "attended", False))
    except (ImportError, ValueError):
        return False  # it cannot be built, and is refused for that
