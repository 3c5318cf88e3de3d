from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from see2act.robot.simulated import SimulatedRobot
from see2act.robot.simulation import TIMESTEP
from see2act.robot.types import Outcome
from see2act.robot.video import BYSTANDER, FRAME_STEPS, film


@pytest.fixture(scope="module")
def robot(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("robot.video=true")


def _pick(robot: SimulatedRobot) -> Outcome:
    robot.reset(31, "seen", 2)
    return robot.execute(robot.workspace.pick(robot.observe().heightmap, 72, 72, 0.0))


@pytest.mark.slow
def test_a_film_shows_the_arm_moving_and_changes_no_outcome(robot: SimulatedRobot, tmp_path: Path) -> None:
    unfilmed = _pick(robot)
    with robot.film(tmp_path / "pick.mp4"):
        filmed = _pick(robot)
    assert filmed == unfilmed
    with av.open(str(tmp_path / "pick.mp4")) as file:
        assert file.streams.video[0].codec_context.name == "h264"
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(frames) >= filmed.robot_seconds / TIMESTEP / FRAME_STEPS  # free motion is shown, though it takes no physics
    assert frames[0].shape == (480, 640, 3)
    picking = frames[-int(filmed.robot_seconds / TIMESTEP / FRAME_STEPS) :]  # before it the objects fall
    moved = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(picking)]
    assert np.median(moved) > 0.1


def test_a_film_that_breaks_leaves_no_file(robot: SimulatedRobot, tmp_path: Path) -> None:
    small = replace(BYSTANDER, width=64, height=48, focal=60.0)
    robot._build()

    def broken() -> None:
        with film(robot.simulation, tmp_path / "pick.mp4", small):
            robot.arm.wait(40)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken()
    assert not list(tmp_path.iterdir())
    assert robot.simulation.after_step is None


def test_without_the_switch_nothing_is_filmed(make_robot: Callable[..., SimulatedRobot], tmp_path: Path) -> None:
    robot = make_robot()
    robot._build()
    with robot.film(tmp_path / "pick.mp4"):
        robot.arm.wait(40)
    assert not list(tmp_path.iterdir())
