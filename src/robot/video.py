"""Recording videos of the arm from a fixed viewpoint."""

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
"""A view of the arm, the bin and the object in the tool."""
FRAME_STEPS = 16
"""Timesteps per frame: 15 frames per simulated second."""
FRAME_RATE = 30
"""Frames per second during playback: twice as fast as the arm moves."""


@contextmanager
def film(simulation: Simulation, path: Path, view: Camera = BYSTANDER) -> Iterator[None]:
    """Record what ``view`` sees during the block as an MP4 (H.264) at twice the speed.

    This renders one frame (0.1 s) per 16 timesteps and does not change the simulation. The file is written when the block
    ends, unless it ends with an error.
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
        file.mux(stream.encode())  # frames still in the encoder
