"""Librealsense: its library, its devices, and its lenses."""

from __future__ import annotations

import ctypes
import logging
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from see2act.robot.real.camera import CameraError

log = logging.getLogger("see2act")


def library() -> Any:
    """The package pyrealsense2.

    Raises:
        CameraError: It is not there, or the library libusb is not.
    """
    _load_libusb()
    try:
        import pyrealsense2
    except ImportError as error:
        raise CameraError(f"a RealSense camera needs the package pyrealsense2 ({error}): pip install 'see2act[real]'") from None
    return pyrealsense2


def connected(context: Any) -> list[Any]:
    """The cameras at this computer."""
    return list(context.query_devices())


def choose(devices: list[Any], serial: str | None) -> Any:
    """The device with a serial number; for None the only one.

    Raises:
        CameraError: It is not there, or there are several.
    """
    found = {info(device, "serial_number"): device for device in devices}
    names = ", ".join(f"{number} ({info(device, 'name')})" for number, device in found.items())
    if not found:
        raise CameraError(
            "no RealSense camera is connected: check its cable; where `lsusb` lists it, install the udev rules of librealsense"
        )
    if serial is None and len(found) > 1:
        raise CameraError(f"several RealSense cameras are connected, {names}: choose one by camera.serial=SERIAL")
    if serial is not None and serial not in found:
        raise CameraError(f"RealSense camera {serial} is not connected: check its cable, or camera.serial; there is {names}")
    device = found[serial] if serial else devices[0]
    if info(device, "usb_type_descriptor").startswith("2"):
        log.warning(
            f"RealSense camera {info(device, 'serial_number')} has a slow USB 2 link, which carries few sizes and rates: use a "
            "USB 3 port and cable"
        )
    return device


def start(pipeline: Any, device: Any, request: tuple[int, int, int]) -> Any:
    """Start a camera with images of a width, height (pixels) and rate (images a second).

    Returns:
        The pipeline's profile.

    Raises:
        CameraError: It has no such images, or does not start.
    """
    rs = library()
    config = rs.config()
    width, height, fps = request
    config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    pipeline.set_device(device)
    try:
        return pipeline.start(config)
    except RuntimeError as error:
        camera, offers = f"RealSense camera {info(device, 'serial_number')}", _offers(device)
        if request in offers:
            raise CameraError(
                f"{camera} does not start ({error}): close other programs that use it, or plug it out and in again"
            ) from None
        some = ", ".join(f"{width} x {height} at {fps}" for width, height, fps in offers[:8])
        raise CameraError(
            f"{camera} does not give colour and depth of {width} x {height} pixels at {fps} a second on this link: set "
            f"camera.width, camera.height and camera.fps to one of {some}"
        ) from None


def play(pipeline: Any, recording: str) -> Any:
    """Start a recording. It is played once, at the pace at which it was made.

    (Librealsense 2.59 can also play it over and over, or as fast as it is read, but then it stalls and crashes now and then.)

    Returns:
        The pipeline's profile.

    Raises:
        CameraError: It is not there, or is no recording of colour and depth.
    """
    rs = library()
    if not Path(recording).is_file():
        raise CameraError(f"there is no recording {recording}: check camera.recording")
    config = rs.config()
    config.enable_device_from_file(recording, repeat_playback=False)
    config.enable_stream(rs.stream.color, 0, 0, rs.format.rgb8, 0)  # 0 is any
    config.enable_stream(rs.stream.depth, 0, 0, rs.format.z16, 0)
    try:
        return pipeline.start(config)
    except RuntimeError as error:
        raise CameraError(
            f"{recording} is no recording of colour (rgb8) and depth (z16) that can be played ({error}): record it again"
        ) from None


def stop(pipeline: Any, device: Any) -> None:
    """Stop a camera or a recording."""
    with suppress(RuntimeError):  # it stopped by itself when the camera was lost
        pipeline.stop()
    if device.is_playback():
        device.as_playback().pause()  # waits for the thread that reads the file: it must not outlive the device


def info(device: Any, key: str) -> str:
    """What a device says about itself; nothing where it says nothing.

    Args:
        key: Name in ``pyrealsense2.camera_info``.
    """
    kind = getattr(library().camera_info, key)
    return str(device.get_info(kind)) if device.supports(kind) else ""


def matrix(lens: Any) -> Float[np.ndarray, "3 3"]:
    """Pinhole matrix of the intrinsics of a stream."""
    return np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])


def is_pinhole(lens: Any) -> bool:
    """Whether a lens does not distort."""
    fisheye = library().distortion.ftheta, library().distortion.kannala_brandt4
    return not any(lens.coeffs) and lens.model not in fisheye


def distorted(lens: Any) -> Float[np.ndarray, "h w 2"]:
    """Column and row in a stream's image of each pixel of the pinhole image, float32.

    By librealsense's own function: its model of the D400 series, though called inverse, distorts as OpenCV's does, but for a
    small term.
    """
    project = library().rs2_project_point_to_pixel
    xs = ((np.arange(lens.width) - lens.ppx) / lens.fx).tolist()
    ys = ((np.arange(lens.height) - lens.ppy) / lens.fy).tolist()
    pixels = [project(lens, (x, y, 1.0)) for y in ys for x in xs]
    return np.array(pixels, np.float32).reshape(lens.height, lens.width, 2)


def rays(lens: Any) -> Float[np.ndarray, "h w 3"]:
    """Point at depth 1 of each pixel of a stream's image.

    Raises:
        CameraError: Librealsense cannot invert the model of the lens.
    """
    rs = library()
    cols, rows = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    if is_pinhole(lens):
        return np.stack([(cols - lens.ppx) / lens.fx, (rows - lens.ppy) / lens.fy, np.ones(cols.shape)], -1)
    points = [rs.rs2_deproject_pixel_to_point(lens, (col, row), 1.0) for row, col in np.ndindex(*cols.shape)]
    corner = rs.rs2_project_point_to_pixel(lens, points[0])
    if np.abs(corner).max() > 0.1:  # pixels; librealsense does not say that it has no inverse
        raise CameraError(
            f"the depth camera has a lens ({lens.model.name}) that librealsense cannot invert: use another camera"
        )
    return np.reshape(points, (*cols.shape, 3))


def _load_libusb() -> None:
    """Load the library that pyrealsense2 is linked with and does not bring along: the system's, or that of a package."""
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            raise CameraError(
                "a RealSense camera needs the library libusb: pip install 'see2act[real]' or apt install libusb-1.0-0"
            ) from None


def _offers(device: Any) -> list[tuple[int, int, int]]:
    """Width, height and rate that colour and depth have in common, the largest first."""
    rs = library()
    kinds: dict[Any, set[tuple[int, int, int]]] = {rs.format.rgb8: set(), rs.format.z16: set()}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.format() in kinds:
                video = profile.as_video_stream_profile()
                kinds[profile.format()].add((video.width(), video.height(), video.fps()))
    return sorted(set.intersection(*kinds.values()), reverse=True)
