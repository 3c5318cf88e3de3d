"""A film of the arm at work, from a fixed viewpoint."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import av
from see2act.files import replacing
from see2act.robot.camera import Camera, DepthNoise
from see2act.robot.simulation import Simulation

BYSTANDER = Camera("bystander", (0.75, -0.75, 0.75), (-0.08, 0.0, 0.15), (0, 0, 1), 640, 480, 600.0, DepthNoise())
"""Sees the arm, the bin and what hangs from the tool."""
FRAME_STEPS = 16
"""Timesteps between two frames: 15 frames per simulated second."""
FRAME_RATE = 30
"""Frames per second when played: twice as fast as the arm moves."""


@contextmanager
def film(simulation: Simulation, path: Path, view: Camera = BYSTANDER) -> Iterator[None]:
    """Write what ``view`` sees during the block to an MP4 (H.264), at twice the speed.

    Takes a rendering (0.1 s) per 16 timesteps and changes nothing in the simulation. The file is there when the block
    has ended, and not if it ended with an error.
    """
    with replacing(path) as partial, av.open(str(partial), "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=FRAME_RATE)
        stream.width, stream.height, stream.pix_fmt = view.width, view.height, "yuv420p"

        watched = count()

        def record() -> None:
            if next(watched) % FRAME_STEPS == 0:
                color, _, _ = view.render(simulation)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(color, format="rgb24")))

        simulation.after_step = record
        try:
            yield
        finally:
            simulation.after_step = None
        file.mux(stream.encode())  # what the encoder still holds
