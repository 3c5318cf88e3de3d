"""A PyBullet world with fixed timesteps, independent of the wall clock."""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int


@contextmanager
def _quiet(stream: int) -> Iterator[None]:
    """Silence PyBullet, which prints to stderr (2) when it is imported and to stdout (1) when a client connects."""
    sys.stdout.flush()
    kept, nowhere = os.dup(stream), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream)
    try:
        yield
        ctypes.CDLL(None).fflush(None)  # C buffers its output if stdout is not a terminal
    finally:
        os.dup2(kept, stream)
        os.close(kept)
        os.close(nowhere)


with _quiet(2):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

TIMESTEP = 1 / 240
"""Simulated seconds per step. This is Bullet's default, for which its contact solver is tuned."""
GRAVITY = -9.81
"""m/s^2 along z."""
SOLVER_ITERATIONS = 160
"""Maximum number; see ``RESIDUAL``. When the gripper closes on a wall, its linkage sinks into the wall by up to 3.4 mm with 80
iterations, 2.0 mm with 120 and 1.1 mm with 160 (300 picks)."""
RESIDUAL = 1e-5
"""Bullet's solver stops iterating once the largest velocity error of any constraint is below this. Its default is 1e-7. 1e-4 is
a third faster, but objects at rest creep: the fastest object of a bin by 1.5 mm/s instead of 0.3 mm/s (means of 40 bins)."""
RAYS_AT_ONCE = 8192
"""Rays per batch. Bullet silently drops rays near its limit of 16384."""


@dataclass(frozen=True)
class Hits:
    """Where each ray first meets a body."""

    body: Int[np.ndarray, " n"]
    """Id of the body; -1 if the ray meets nothing."""
    position: Float[np.ndarray, "n 3"]
    """World metres; the end of the ray if it meets nothing."""
    normal: Float[np.ndarray, "n 3"]
    """Surface normal; zeros if the ray meets nothing."""


class Simulation:
    """A private PyBullet client. Call :meth:`close` when done."""

    def __init__(self) -> None:
        if not pybullet.isNumpyEnabled():
            raise RuntimeError(
                "this build of pybullet lacks NumPy support, camera images would take seconds: reinstall pybullet"
            )
        with _quiet(1):
            self.client = BulletClient(pybullet.DIRECT)
        self.steps = 0
        self.after_step: Callable[[], None] | None = None
        """Called after each step, and for each step that free motion skips. It must not change the simulation."""

    def clear(self) -> None:
        """Remove everything, so that nothing depends on earlier contents."""
        self.client.resetSimulation()
        self.client.setGravity(0, 0, GRAVITY)
        self.client.setTimeStep(TIMESTEP)
        self.client.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=RESIDUAL,
            enableConeFriction=0,  # use a friction pyramid, which converges in fewer iterations
            deterministicOverlappingPairs=1,  # solve contacts in the same order in every process
        )

    def step(self) -> None:
        """Advance by one timestep."""
        self.client.stepSimulation()
        self.steps += 1
        if self.after_step is not None:
            self.after_step()

    @contextmanager
    def hidden(self, *bodies: int) -> Iterator[None]:
        """Hide these bodies from all cameras during the block."""
        looks = [(body, shape[1], shape[7]) for body in bodies for shape in self.client.getVisualShapeData(body)]
        for body, link, color in looks:
            self.client.changeVisualShape(body, link, rgbaColor=(*color[:3], 0))
        try:
            yield
        finally:
            for body, link, color in looks:
                self.client.changeVisualShape(body, link, rgbaColor=color)

    def cast(self, starts: Float[np.ndarray, "n 3"], ends: Float[np.ndarray, "n 3"], groups: int = -1) -> Hits:
        """Cast rays between world points.

        Args:
            starts, ends: End points of each ray, world metres.
            groups: Bit mask of the collision groups that rays can meet; by default all.
        """
        hits: list[tuple] = []
        for i in range(0, len(starts), RAYS_AT_ONCE):
            part = slice(i, i + RAYS_AT_ONCE)
            hits += self.client.rayTestBatch(starts[part].tolist(), ends[part].tolist(), collisionFilterMask=groups)
        body = np.array([hit[0] for hit in hits], int)
        position, normal = (np.array([hit[k] for hit in hits]).reshape(-1, 3) for k in (3, 4))
        return Hits(body, np.where(body[:, None] < 0, ends, position), normal)

    def close(self) -> None:
        """Disconnect the client. Safe to call twice."""
        if self.client.isConnected():
            self.client.disconnect()


def file_of(content: bytes, ending: str) -> Path:
    """A file with this content, for Bullet to read.

    Equal contents have the same path throughout a process: Bullet keeps what it has read from every path in memory, also after
    its client has been closed.

    Args:
        content: The whole file.
        ending: Of its name: ``.obj``.
    """
    path = Path(_files(os.getpid()).name) / f"{hashlib.sha256(content).hexdigest()}{ending}"
    if not path.exists():
        path.write_bytes(content)
    return path


@cache
def _files(_process: int) -> TemporaryDirectory:
    return TemporaryDirectory(prefix="see2act-")
