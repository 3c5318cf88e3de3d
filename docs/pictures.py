"""Makes the pictures of these pages: `python docs/pictures.py`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from see2act import build
from see2act.config import register
from see2act.robot.camera import Camera, DepthNoise

DOCS = Path(__file__).parent
VIEW = Camera("bystander", (0.75, -0.75, 0.75), (-0.08, 0.0, 0.15), (0, 0, 1), 960, 720, 900.0, DepthNoise())


def robot_over_bin(primitive: str) -> np.ndarray:
    """The arm lowering its tool onto an object, RGB."""
    register()
    with initialize_config_module("see2act.conf", version_base="1.3"):
        cfg = compose("train", ["paths.output=.", f"primitive={primitive}"])
    robot = build.robot_factory(cfg, cfg.primitive)()
    robot.reset(4, "seen")
    heightmap = robot.observe().heightmap
    row, col = np.unravel_index(np.argmax(heightmap.height[20:-20, 20:-20]), (104, 104))
    pick = robot.workspace.pick(heightmap, int(row) + 20, int(col) + 20, np.pi / 4)
    at = np.array([pick.x, pick.y, pick.z + robot.tool.length() + 0.02])
    joints = robot.arm.solve(at, pick.angle)
    assert joints is not None
    robot.arm.teleport(joints)
    color, _, _ = VIEW.render(robot.simulation)
    robot.close()
    return color


if __name__ == "__main__":
    picture = np.hstack([robot_over_bin("suction"), robot_over_bin("grasp")])
    cv2.imwrite(str(DOCS / "robot.png"), cv2.resize(picture, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)[..., ::-1])
