"""What several tests need: the real configuration, and a robot built from it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest
import torch
from hypothesis import settings
from omegaconf import DictConfig

from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.robot.simulated import SimulatedRobot

# As many tests run at once as there are cores. Threads of torch that find no free core wait for each other, busily.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the commands that tests run
settings.register_profile("long", max_examples=10 * settings.default.max_examples)  # pytest --hypothesis-profile=long


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
