"""Intel RealSense cameras, live or from a recording."""

from __future__ import annotations

import logging
from threading import Thread
from time import monotonic
from typing import Any
from weakref import finalize

import numpy as np
from jaxtyping import Float

from see2act.robot.real import librealsense
from see2act.robot.real.camera import CameraError, DepthCamera, Frame
from see2act.robot.real.frames import Count, Registration, Seconds, median_color, median_depth, rectify

WARM_UP = 30
"""Pairs of images that are thrown away after the start: a second at 30 a second, in which exposure and white balance settle.
(Intel's examples throw 5 to 30 away.)"""
STALE = 3
"""Pairs of images that are thrown away at a reading, because they may have been taken before it: the one that waits in
librealsense's queue, one on its way through the camera and the cable, and one whose exposure has begun."""
END = 1.0
"""Seconds without an image after which a recording is started again: it has come to its end. (Some starts also give none.)"""
log = logging.getLogger("see2act")


class RealSense(DepthCamera):
    """A RealSense camera of the D400 series. Colour is undistorted, and depth is given to the pixels of colour.

    Args:
        name: Name used in the configuration.
        serial: Which camera: the number on it. None for the only one that is connected.
        width, height: Size of the images, pixels; of colour and depth alike.
        fps: Images a second.
        frames: Images of which a reading is the median.
        recording: A file of librealsense or its viewer (``.db3``) that is played instead, over and over; None for the camera
            itself. Size and rate are then those of the file.
        timeout: Seconds without an image after which the camera counts as lost.
    """

    def __init__(
        self,
        name: str,
        serial: str | int | None,
        width: Count,
        height: Count,
        fps: Count,
        frames: Count,
        recording: str | None,
        timeout: Seconds = 5.0,
    ):
        self.name = name
        self._wanted = None if serial is None else str(serial)  # typed on a command line, it is a number
        self._request, self._recording = (width, height, fps), recording
        self._frames, self._timeout = frames, timeout
        self._serial = ""
        self._pipeline: Any = None
        self._profile: Any = None
        self._device: Any = None

    def open(self) -> None:
        self._start()
        try:
            self._set_up()
            for _ in range(WARM_UP):
                self._next()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        if self._pipeline is None:
            return
        self._pipeline = self._profile = self._device = None
        thread = Thread(target=self._stop, daemon=True)
        thread.start()
        thread.join(self._timeout)  # librealsense has been seen to wait for ever for a camera that is gone
        if thread.is_alive():
            log.warning(f"RealSense camera {self._serial} does not stop: plug it out and in again")

    @property
    def serial(self) -> str:
        self._check_open()
        return self._serial

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        self._check_open()
        return self._intrinsics.copy()

    def read(self) -> Frame:
        self._check_open()
        for _ in range(STALE):
            self._next()
        colors, depths = [], []
        for _ in range(self._frames):
            color, depth = self._next()
            colors.append(np.array(color.get_data()))  # copies: librealsense has few images to lend
            depths.append(np.array(depth.get_data()))
            unit = np.float32(depth.get_units())
        image = median_color(colors)
        if self._source is not None:
            image = rectify(image, self._source, smooth=True)
        return Frame(image, self._register(median_depth(depths) * unit))

    def _start(self) -> None:
        rs = librealsense.library()
        context = rs.context()
        pipeline = rs.pipeline(context)
        if self._recording:
            self._profile = librealsense.play(pipeline, self._recording)
        else:
            device = librealsense.choose(librealsense.connected(context), self._wanted)
            self._profile = librealsense.start(pipeline, device, self._request)
        self._pipeline, self._device = pipeline, self._profile.get_device()
        self._stop = finalize(self, librealsense.stop, pipeline, self._device)  # it also runs at the end of the program
        self._last = (-1, -1)

    def _set_up(self) -> None:
        """Take over what is known of the camera that was started."""
        rs = librealsense.library()
        self._serial = librealsense.info(self._device, "serial_number")
        if self._recording and self._wanted not in (None, self._serial):
            raise CameraError(f"{self._recording} is of camera {self._serial}: set camera.serial to it, or to null")
        streams = (self._profile.get_stream(kind) for kind in (rs.stream.color, rs.stream.depth))
        color, depth = (stream.as_video_stream_profile() for stream in streams)
        lens, between = color.intrinsics, depth.get_extrinsics_to(color)
        self._intrinsics = librealsense.matrix(lens)
        self._source = None if librealsense.is_pinhole(lens) else librealsense.distorted(lens)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.reshape(between.rotation, (3, 3)).T, between.translation  # it is stored by columns
        rays = librealsense.rays(depth.intrinsics)
        self._register = Registration(rays, pose, self._intrinsics, (lens.height, lens.width))

    def _next(self) -> tuple[Any, Any]:
        """Colour and depth that follow the ones before."""
        deadline = monotonic() + self._timeout
        error: object = "colour or depth stands still"
        while (left := deadline - monotonic()) > 0:
            try:
                images = self._pipeline.wait_for_frames(int(1000 * (min(left, END) if self._recording else left)) + 1)
            except RuntimeError as reason:
                error = reason
                if not self._recording:
                    break
                self._stop()
                self._start()
                continue
            color, depth = images.get_color_frame(), images.get_depth_frame()
            numbers = color.get_frame_number(), depth.get_frame_number()
            if numbers[0] != self._last[0] and numbers[1] != self._last[1]:  # librealsense repeats one where the next is late
                self._last = numbers
                return color, depth
        if self._recording:
            raise CameraError(f"{self._recording} gives no pairs of colour and depth ({error}): record it again")
        raise CameraError(
            f"RealSense camera {self._serial} gives no images ({error}): check its cable, plug it out and in again, and type "
            "the same command again"
        )

    def _check_open(self) -> None:
        if self._pipeline is None:
            raise CameraError(f"camera {self.name} is not open: call open() first")
