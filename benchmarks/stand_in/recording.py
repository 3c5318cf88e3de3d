"""A RealSense camera without the camera: images go through librealsense as a device's do, live or by way of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from see2act.robot.real.librealsense import library

Images = tuple[UInt8[np.ndarray, "H W 3"], UInt16[np.ndarray, "h w"]]
"""Colour (RGB) and raw depth (counts of the camera's unit), each as its own camera sees it."""


@dataclass(frozen=True)
class Lens:
    """One of the two cameras."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    """Pixels; the centre of a pixel is at its index."""
    cy: float
    model: str = "none"
    """Name in ``pyrealsense2.distortion``."""
    coefficients: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def intrinsics(self) -> Any:
        """As librealsense has it."""
        rs = library()
        result = rs.intrinsics()
        result.width, result.height = self.width, self.height
        result.fx, result.fy, result.ppx, result.ppy = self.fx, self.fy, self.cx, self.cy
        result.model, result.coeffs = getattr(rs.distortion, self.model), list(self.coefficients)
        return result


class SoftwareCamera:
    """A camera that shows what it is given.

    Args:
        color, depth: Its two cameras.
        pose: The depth camera in the frame of the colour camera, metres.
        unit: Metres per count of depth.
        usb: Version of the USB link, as librealsense writes it.
    """

    def __init__(
        self,
        color: Lens,
        depth: Lens,
        pose: Float[np.ndarray, "4 4"] | None = None,
        serial: str = "000000000001",
        unit: float = 0.001,
        fps: int = 30,
        usb: str = "3.2",
    ):
        self._rs = rs = library()
        self._unit, self._fps, self._count = unit, fps, 0
        self.device = rs.software_device()
        """For ``pyrealsense2.pipeline.set_device``."""
        infos = {"name": "Intel RealSense D415", "serial_number": serial, "product_line": "D400", "usb_type_descriptor": usb}
        for info, value in infos.items():
            self.device.register_info(getattr(rs.camera_info, info), value)
        self._depth = self.device.add_sensor("Stereo Module")
        self._color = self.device.add_sensor("RGB Camera")
        self._depth.add_read_only_option(rs.option.depth_units, unit)
        self._depth_profile = self._stream(self._depth, 0, rs.stream.depth, rs.format.z16, 2, depth)
        self._color_profile = self._stream(self._color, 1, rs.stream.color, rs.format.rgb8, 3, color)
        pose = np.eye(4) if pose is None else pose
        extrinsics = rs.extrinsics()
        extrinsics.rotation, extrinsics.translation = pose[:3, :3].T.ravel().tolist(), pose[:3, 3].tolist()
        self._depth_profile.register_extrinsics_to(self._color_profile, extrinsics)
        self.device.create_matcher(rs.matchers.default)

    def show(self, color: UInt8[np.ndarray, "H W 3"], depth: UInt16[np.ndarray, "h w"]) -> None:
        """Send the next pair of images to whoever has started the device."""
        self._count += 1
        for sensor, profile, image in (
            (self._depth, self._depth_profile, np.ascontiguousarray(depth)),
            (self._color, self._color_profile, np.ascontiguousarray(color)),
        ):
            frame = self._rs.software_video_frame()
            frame.profile, frame.pixels = profile, image
            frame.bpp, frame.stride = image[0, 0].nbytes, image[0].nbytes
            frame.frame_number, frame.timestamp = self._count, 1000 * self._count / self._fps
            frame.domain = self._rs.timestamp_domain.hardware_clock
            frame.depth_units = self._unit
            sensor.on_video_frame(frame)

    def _stream(self, sensor: Any, uid: int, kind: Any, form: Any, size: int, lens: Lens) -> Any:
        stream = self._rs.video_stream()
        stream.type, stream.index, stream.uid = kind, 0, uid
        stream.fmt, stream.bpp, stream.fps = form, size, self._fps
        stream.width, stream.height, stream.intrinsics = lens.width, lens.height, lens.intrinsics()
        return sensor.add_video_stream(stream).as_video_stream_profile()


def record(path: Path, camera: SoftwareCamera, images: Iterable[Images], pace: float = 0.005) -> None:
    """Write a recording that :class:`~see2act.robot.real.realsense.RealSense` plays.

    Args:
        path: Ends in ``.db3``. Replaced where it exists.
        images: Two or more; librealsense makes no pair of the images of a recording of one.
        pace: Seconds between two pairs, also when they are played.
    """
    path.unlink(missing_ok=True)
    rs = library()
    recorder = rs.recorder(str(path), camera.device)
    sensors = recorder.query_sensors()
    queue = rs.frame_queue(1)
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for color, depth in images:
        camera.show(color, depth)
        sleep(pace)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
