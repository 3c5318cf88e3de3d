"""Small tries of what a run will do, where neither a type nor a constructor says that it cannot."""

from __future__ import annotations

from typing import Any

import cv2
import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from see2act.datamodules.labels import View
from see2act.errors import ConfigError
from see2act.experiment import build
from see2act.experiment.config import one_line
from see2act.experiment.quiet import quiet
from see2act.robot.types import RobotError


def try_collector(cfg: DictConfig) -> None:
    """Build the robot that collects, which has a tool of its own."""
    try:
        build.robot_factory(cfg, cfg.collect.primitive)().close()
    except (RobotError, HydraException) as error:
        raise ConfigError(f"collect.primitive: {one_line(error.__cause__ or error)}") from None


def try_shape(cfg: DictConfig) -> None:
    """Run a heightmap through the network: a vision model learns from whole ones, of whatever size the workspace has."""
    rows, cols = instantiate(cfg.workspace).shape
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        network = instantiate(cfg.model.network).eval()
        try:
            given = tuple(network(torch.zeros(1, 4, rows, cols)).shape)
        except (RuntimeError, ValueError, AssertionError) as error:
            raise ConfigError(
                f"model={cfg.model.name} takes no heightmap of {rows} x {cols} pixels: {one_line(error)}"
            ) from None
    if given != (1, 1, rows, cols):
        raise ConfigError(
            f"model={cfg.model.name} gives {given} for a heightmap of {rows} x {cols} pixels, not (1, 1, {rows}, {cols}): "
            f"its head must give a logit for every pixel of an input whose sides are multiples of its stride, {network.stride}"
        )


def try_labels(cfg: DictConfig) -> None:
    """Label a block on the floor: which windows and blurs OpenCV takes, it says no earlier."""
    view = View.of_a_block(instantiate(cfg.workspace).shape)
    try:
        label = build.task(cfg).label(view, cfg.labels)
    except ConfigError as error:
        raise ConfigError(f"task.label: {error}") from None
    except HydraException as error:
        raise ConfigError(one_line(error.__cause__ or error)) from None
    except (cv2.error, ArithmeticError, MemoryError, ValueError) as error:
        raise ConfigError(f"task={cfg.task.name} labels no heightmap ({one_line(error)}): check task.label") from None
    if label.shape != view.body.shape:
        raise ConfigError(
            f"task={cfg.task.name} gives labels of {label.shape} for a heightmap of {view.body.shape}: mend its class"
        )


def try_trainer(cfg: DictConfig, here: dict[str, Any]) -> None:
    """Build one, since what it asks for need not be in this machine."""
    quiet()
    try:
        instantiate(cfg.trainer)(**here)
    except (HydraException, MisconfigurationException, ImportError, ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"this machine has no such trainer: {one_line(error)}") from None
