"""One PyBullet world, stepped at a fixed rate and never by the clock."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """PyBullet writes its build time to the terminal on import; what we say there should be all there is."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _quiet_stderr():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

TIMESTEP = 1 / 240
"""Seconds of simulated time per step: Bullet's default, which its contact solver is tuned for."""
GRAVITY = -9.81
SOLVER_ITERATIONS = 60


class Simulation:
    """A private PyBullet client. Close it, or use it as a context manager."""

    def __init__(self) -> None:
        if not pybullet.isNumpyEnabled():
            raise RuntimeError(
                "this build of pybullet lacks NumPy support, camera images would take seconds: reinstall pybullet"
            )
        self.client = BulletClient(pybullet.DIRECT)
        self.steps = 0

    def clear(self) -> None:
        """Remove everything, so that what follows depends on nothing that was."""
        self.client.resetSimulation()
        self.client.setGravity(0, 0, GRAVITY)
        self.client.setTimeStep(TIMESTEP)
        # Deterministic overlapping pairs: contacts are solved in the same order in every process.
        self.client.setPhysicsEngineParameter(numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1)

    def step(self) -> None:
        """Advance by one timestep."""
        self.client.stepSimulation()
        self.steps += 1

    def close(self) -> None:
        """Give the client back; safe to call twice."""
        if self.client.isConnected():
            self.client.disconnect()
