"""One attempt: observe, decide, act. Fine-tuning and evaluation share this code."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from see2act.policy import Choice, Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Heightmap, Observation, Outcome, Pick
from see2act.robot.workspace import Workspace

Affordances = Callable[[np.ndarray, np.ndarray], Float[np.ndarray, "A H W"]]
"""Maps colour (H, W, 3) uint8 and height (H, W) in metres to logits of success."""


@dataclass(frozen=True)
class Attempt:
    """One attempt: observation, choice, pick and outcome. The times are wall-clock seconds and for information only."""

    observation: Observation
    choice: Choice
    pick: Pick
    outcome: Outcome
    t_observe: float
    t_decide: float
    t_act: float

    @property
    def heightmap(self) -> Heightmap:
        """The heightmap on which the pick was chosen."""
        return self.observation.heightmap


def attempt(
    robot: Robot,
    affordances: Affordances,
    policy: Policy,
    temperature: float = 0.0,
    rng: np.random.Generator | None = None,
) -> Attempt:
    """Observe, decide and act. The policy remembers the outcome."""
    start = time.perf_counter()
    observation = robot.observe()
    seen = time.perf_counter()
    choice, pick = decide(observation, robot.workspace, affordances, policy, temperature, rng)
    decided = time.perf_counter()
    outcome = robot.execute(pick)
    policy.remember(choice, observation.heightmap, outcome.success)
    acted = time.perf_counter()
    return Attempt(observation, choice, pick, outcome, seen - start, decided - seen, acted - decided)


def decide(
    observation: Observation,
    workspace: Workspace,
    affordances: Affordances,
    policy: Policy,
    temperature: float = 0.0,
    rng: np.random.Generator | None = None,
) -> tuple[Choice, Pick]:
    """The policy's choice for an observation, and the corresponding pick."""
    heightmap = observation.heightmap
    logits = affordances(heightmap.color, heightmap.height)
    choice = policy.choose(logits, heightmap, temperature, rng)
    return choice, workspace.pick(heightmap, choice.row, choice.col, choice.angle * math.pi / len(logits))
