"""What several tests need: the real configuration, and a robot built from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from omegaconf import DictConfig
from see2act import build
from see2act.config import composed
from see2act.robot.robot import SimulatedRobot


@pytest.fixture(scope="session")
def config() -> Callable[..., DictConfig]:
    """Composes the real configuration with overrides."""
    return lambda *overrides: composed(overrides)


@pytest.fixture(scope="session")
def make_robot(config: Callable[..., DictConfig]) -> Iterator[Callable[..., SimulatedRobot]]:
    """Builds robots with the real configuration and closes them at the end."""
    robots = []

    def make(*overrides: str) -> SimulatedRobot:
        cfg = config(*overrides)
        robots.append(build.robot_factory(cfg, cfg.primitive)())
        return robots[-1]

    yield make
    for robot in robots:
        robot.close()
