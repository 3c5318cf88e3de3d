"""Settled scenes are kept, and a kept scene is the scene that was dropped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from see2act.experiment import build
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.simulation import TIMESTEP


def _played(robot: SimulatedRobot, seed: int = 11) -> tuple:
    """What a scene looks like and what a pick does in it, with all digits."""
    robot.reset(seed, "seen")
    observation = robot.observe()
    row, col = np.argwhere(robot.truth().body >= 0)[40]
    outcome = robot.execute(robot.workspace.pick(observation.heightmap, int(row), int(col), 0.0))
    places = [robot.simulation.client.getBasePositionAndOrientation(body.id) for body in robot.scene.bodies]
    return observation.heightmap.height.tobytes(), observation.color.tobytes(), outcome, places


@pytest.mark.parametrize("primitive", ["suction", "grasp"])
def test_a_kept_scene_equals_a_dropped_one_to_the_bit(
    make_robot: Callable[..., SimulatedRobot], tmp_path: Path, primitive: str
) -> None:
    dropped = _played(make_robot(f"primitive={primitive}", "robot.layouts=null"))
    robot = make_robot(f"primitive={primitive}", f"robot.layouts={tmp_path}")
    assert _played(robot) == dropped
    drop = robot.scene.drop
    robot.scene.drop = lambda *args: pytest.fail("it was kept, and is dropped again")
    assert _played(robot) == dropped
    robot.scene.drop = drop


def test_both_tools_share_their_scenes_and_other_bins_do_not(config: Callable, tmp_path: Path) -> None:
    def folder(*overrides: str) -> str:
        cfg = config(f"robot.layouts={tmp_path}", *overrides)
        return build.robot_factory(cfg, cfg.primitive).keywords["robot"]["layouts"]

    assert folder() == folder("primitive=grasp") == folder("camera=top") == folder("robot.video=true")
    others = [("robot.bin.friction=0.5",), ("objects=household",), ("workspace=suction_real",), ("objects.scale=[0.9,1.2]",)]
    assert len({folder(), *(folder(*other) for other in others)}) == 1 + len(others)


@pytest.mark.parametrize("left", [0, -20, None])
def test_a_damaged_file_is_made_again(
    make_robot: Callable[..., SimulatedRobot], tmp_path: Path, left: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    robot = make_robot(f"robot.layouts={tmp_path}")
    robot.reset(11, "seen", 1)
    (kept,) = tmp_path.rglob("*.json")
    whole = kept.read_text()
    kept.write_text('{"objects": [{}]}' if left is None else whole[:left])
    robot.reset(11, "seen", 1)
    assert f"{kept} is damaged, and is made again" in caplog.text
    assert kept.read_text() == whole


def test_what_is_put_back_lies_still_when_it_is_woken(make_robot: Callable[..., SimulatedRobot], tmp_path: Path) -> None:
    """Contacts are not kept; without them objects sink and topple once something touches them."""
    robot = make_robot(f"robot.layouts={tmp_path}")
    for scene in (1, 2, 3, 4):
        robot.reset(scene, "seen")
        before = np.array(list(robot.scene.positions().values()))
        robot.scene.wake()
        for _ in range(12):
            robot.simulation.step()
        moved = np.linalg.norm(np.array(list(robot.scene.positions().values())) - before, axis=1)
        assert moved.max() < 0.01 * 12 * TIMESTEP  # 1 cm/s
