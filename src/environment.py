"""The robot as a Gymnasium environment, for other agents.

Importing this module registers ``see2act/BinPicking-v1``. ``gymnasium.make("see2act.environment:see2act/BinPicking-v1")``
imports it and makes the environment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, get_args

import gymnasium
import numpy as np
from gymnasium import spaces

from see2act.experiment import build
from see2act.experiment.checks import check_parts, validate
from see2act.experiment.config import composed
from see2act.robot.types import Observation, Split

NAME = "see2act/BinPicking-v1"
ATTEMPTS = 25
"""Maximum number of attempts per episode (paper, section IV, for seen objects)."""
HEIGHTS = (-0.5, 2.0)
"""Bounds of the heights in an observation, metres."""


class BinPicking(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A UR5 empties a bin. A step is one open-loop pick. The reward is 1 if the robot senses that it holds an object, else 0.

    An observation is the bin seen along gravity: ``color`` (H, W, 3) uint8, and ``height`` (H, W) float32 in metres above
    the floor. An action is (angle, row, col). Row and column are the pixel to pick at. The angle is an index k: the jaws close
    along a direction k / 16 of half a turn counter-clockwise from the image's horizontal. A suction cup has only k = 0. The
    episode terminates when the bin is empty, and is truncated after 25 picks. ``info`` has ``truth``, ``cause``, ``lost``
    and ``robot_seconds``.

    Args:
        overrides: Configuration overrides as for train.py: ``["primitive=grasp", "objects=household"]``.
        split: Which objects to use, ``seen`` or ``unseen``; ``reset(options={"split": ...})`` changes it for one episode.
        render_mode: ``rgb_array`` for the camera's image, or None.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (declared so by Env)

    def __init__(self, overrides: Sequence[str] = (), split: Split = "seen", render_mode: str | None = None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode} is unknown: give rgb_array, or nothing")
        cfg = composed(overrides)
        validate(cfg)
        check_parts(cfg)
        self.render_mode = render_mode
        self._split = _checked(split)
        self._angles = int(cfg.primitive.angles)
        self._robot = build.robot_factory(cfg, cfg.primitive)()
        shape = self._robot.workspace.shape
        maps: dict[str, spaces.Space[Any]] = {
            "color": spaces.Box(0, 255, (*shape, 3), np.uint8),
            "height": spaces.Box(*HEIGHTS, shape, np.float32),
        }
        self.observation_space: spaces.Space[Any] = spaces.Dict(maps)
        self.action_space = spaces.MultiDiscrete([self._angles, *shape])
        self._seen: Observation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start a new scene. The same ``seed`` gives the same sequence of scenes."""
        super().reset(seed=seed)
        split = _checked((options or {}).get("split", self._split))
        self._robot.reset(int(self.np_random.integers(2**31)), split)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Execute one pick.

        Raises:
            ValueError: The action is not in the action space.
        """
        if self._seen is None:
            raise gymnasium.error.ResetNeeded("call reset() before the first step()")
        asked = np.asarray(action)
        if asked.dtype.kind not in "iu" or not self.action_space.contains(asked.astype(np.int64)):
            raise ValueError(f"action {action} is not [angle, row, col] in {self.action_space}")
        angle, row, col = (int(i) for i in action)
        pick = self._robot.workspace.pick(self._seen.heightmap, row, col, angle * math.pi / self._angles)
        outcome = self._robot.execute(pick)
        info = {name: getattr(outcome, name) for name in ("truth", "cause", "lost", "robot_seconds")}
        return self._observe(), float(outcome.success), self._robot.bin_empty(), False, info

    def render(self) -> np.ndarray | None:
        """The camera's latest image, (h, w, 3) uint8; None without a ``render_mode``."""
        return None if self.render_mode is None or self._seen is None else self._seen.color.copy()

    def close(self) -> None:
        """Close the simulator."""
        self._robot.close()

    def _observe(self) -> dict[str, np.ndarray]:
        self._seen = self._robot.observe()
        heightmap = self._seen.heightmap
        return {"color": heightmap.color.copy(), "height": heightmap.height.copy()}  # agents may change them


def _checked(split: Any) -> Split:
    if split not in get_args(Split):
        raise ValueError(f"split={split} is unknown: choose one of {', '.join(get_args(Split))}")
    known: Split = split
    return known


gymnasium.register(id=NAME, entry_point="see2act.environment:BinPicking", max_episode_steps=ATTEMPTS)
