"""One PyBullet world, stepped at a fixed rate and never by the clock."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@contextmanager
def _quiet(stream: int) -> Iterator[None]:
    """PyBullet greets on stderr (2) when imported and on stdout (1) when connected; what we say should be all there is."""
    sys.stdout.flush()
    kept, nowhere = os.dup(stream), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream)
    try:
        yield
        ctypes.CDLL(None).fflush(None)  # C keeps what it prints until later when stdout is no terminal
    finally:
        os.dup2(kept, stream)
        os.close(kept)
        os.close(nowhere)


with _quiet(2):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

TIMESTEP = 1 / 240
"""Seconds of simulated time per step: Bullet's default, which its contact solver is tuned for."""
GRAVITY = -9.81
SOLVER_ITERATIONS = 160
"""At most: see ``RESIDUAL``. The gripper's linkage, closing on a wall, sinks into it by up to 3.4 mm with 80, 2.0 mm with 120
and 1.1 mm with 160 (300 picks)."""
RESIDUAL = 1e-5
"""Bullet's solver stops iterating once the largest error of velocity of any constraint is below this; its default is 1e-7. At
1e-4, a third faster, what lies still creeps: the fastest object of a bin by 1.5 mm/s instead of 0.3 (means of 40 bins)."""
RAYS_AT_ONCE = 8192
"""In one batch; Bullet drops rays silently near its limit of 16384."""


@dataclass(frozen=True)
class Hits:
    """Where rays met the first body."""

    body: Int[np.ndarray, " n"]
    """-1: none."""
    position: Float[np.ndarray, "n 3"]
    """World metres; the ray's end where it met nothing."""
    normal: Float[np.ndarray, "n 3"]
    """Of the surface; zeros where the ray met nothing."""


class Simulation:
    """A private PyBullet client. Close it, or use it as a context manager."""

    def __init__(self) -> None:
        if not pybullet.isNumpyEnabled():
            raise RuntimeError(
                "this build of pybullet lacks NumPy support, camera images would take seconds: reinstall pybullet"
            )
        with _quiet(1):
            self.client = BulletClient(pybullet.DIRECT)
        self.steps = 0
        self.after_step: Callable[[], None] | None = None
        """A spectator, called after each step, and for each that free motion skips; it must change nothing."""

    def clear(self) -> None:
        """Remove everything, so that what follows depends on nothing that was."""
        self.client.resetSimulation()
        self.client.setGravity(0, 0, GRAVITY)
        self.client.setTimeStep(TIMESTEP)
        self.client.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=RESIDUAL,
            enableConeFriction=0,  # a friction pyramid instead: its rows converge in fewer iterations
            deterministicOverlappingPairs=1,  # contacts are solved in the same order in every process
        )

    def step(self) -> None:
        """Advance by one timestep."""
        self.client.stepSimulation()
        self.steps += 1
        if self.after_step is not None:
            self.after_step()

    @contextmanager
    def hidden(self, *bodies: int) -> Iterator[None]:
        """No camera sees these bodies during the block."""
        looks = [(body, shape[1], shape[7]) for body in bodies for shape in self.client.getVisualShapeData(body)]
        for body, link, color in looks:
            self.client.changeVisualShape(body, link, rgbaColor=(*color[:3], 0))
        try:
            yield
        finally:
            for body, link, color in looks:
                self.client.changeVisualShape(body, link, rgbaColor=color)

    def cast(self, starts: Float[np.ndarray, "n 3"], ends: Float[np.ndarray, "n 3"], groups: int = -1) -> Hits:
        """Rays between world points, metres.

        Args:
            starts, ends: Of each ray.
            groups: Bit mask of the collision groups that rays can meet; all by default.
        """
        hits: list[tuple] = []
        for i in range(0, len(starts), RAYS_AT_ONCE):
            part = slice(i, i + RAYS_AT_ONCE)
            hits += self.client.rayTestBatch(starts[part].tolist(), ends[part].tolist(), collisionFilterMask=groups)
        body = np.array([hit[0] for hit in hits], int)
        position, normal = (np.array([hit[k] for hit in hits]).reshape(-1, 3) for k in (3, 4))
        return Hits(body, np.where(body[:, None] < 0, ends, position), normal)

    def close(self) -> None:
        """Give the client back; safe to call twice."""
        if self.client.isConnected():
            self.client.disconnect()
