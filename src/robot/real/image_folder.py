"""Any other depth camera: its own program writes images into a folder, and they are read from there."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep, time
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from see2act.files import replacing, write_json
from see2act.robot.real.camera import CameraError, DepthCamera, Frame
from see2act.robot.real.frames import Count, Seconds, median_color, median_depth, rectify

DESCRIPTION = "camera.json"
COLOR, DEPTHS = ".color.png", (".depth.png", ".depth.npy")
PAUSE = 0.01
"""Seconds between two looks into the folder."""
PNG_END = b"IEND\xaeB`\x82"
"""Last bytes of a PNG file (its specification, section 11.2.5). One that is still being written lacks them."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Description(BaseModel):
    """What ``camera.json`` says of a camera."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    serial: str
    """A name of this one camera. A calibration belongs to it."""
    width: Count
    """Pixels."""
    height: Count
    fx: Positive
    """Pixels."""
    fy: Positive
    cx: Finite
    """Pixels; the centre of a pixel is at its index, so the middle of the image is at (width - 1) / 2."""
    cy: Finite
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of Brown and Conrady, as in OpenCV. All 0 where the images are without distortion."""
    depth_scale: Positive
    """Metres per count of a 16-bit depth image. (Depth in a ``.npy`` file is in metres.)"""

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Pinhole matrix, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


class ImageFolder(DepthCamera):
    """A camera whose own program writes images into a folder, all the time or at least while a reading is awaited.

    The program must do this:

    - Write ``camera.json`` once, with the keys of :class:`Description`.
    - For each shot choose a NAME that was not used before, such as a number or the time, and write two files:
      ``NAME.color.png`` (8 bits, RGB) and either ``NAME.depth.png`` (one channel of 16 bits, counts) or ``NAME.depth.npy``
      (metres). Both show the same pixels; depth is measured along the optical axis, and 0 means none.
    - Write each file under another name in the same folder, and then rename it.
    - Delete old files, whenever it likes. Nothing here does.

    The first shot that appears after a reading was asked for is thrown away, as it may have been taken before. A shot must
    therefore be written before the next one but one is taken. A program in Python can use :func:`describe` and
    :func:`write_pair`.

    Args:
        name: Name used in the configuration.
        folder: Where the images appear.
        frames: Shots of which a reading is the median.
        timeout: Seconds without a new shot after which the camera counts as lost.
    """

    def __init__(self, name: str, folder: str, frames: Count, timeout: Seconds):
        self.name = name
        self._folder, self._frames, self._timeout = Path(folder), frames, timeout
        self._description: Description | None = None

    def open(self) -> None:
        self._description = description = _described(self._folder)
        self._source = None
        if any(description.distortion):
            size, no_turn = (description.width, description.height), np.eye(3)
            matrix, lens = description.intrinsics, np.array(description.distortion)
            maps = cv2.initUndistortRectifyMap(matrix, lens, no_turn, matrix, size, cv2.CV_32FC1)
            self._source = np.stack(maps, -1)

    def close(self) -> None:
        self._description = None

    @property
    def serial(self) -> str:
        return self._opened().serial

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        return self._opened().intrinsics

    def read(self) -> Frame:
        description = self._opened()
        shots = self._shots(description)
        next(shots)
        colors, depths = zip(*(next(shots) for _ in range(self._frames)), strict=True)
        color, depth = median_color(colors), median_depth(depths)
        if self._source is not None:
            color, depth = rectify(color, self._source, smooth=True), rectify(depth, self._source, smooth=False)
        return Frame(color, depth)

    def _shots(self, description: Description) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Colour and depth (metres) of each shot that appears from now on."""
        known = _shots_in(self._folder)
        deadline, trouble = monotonic() + self._timeout, ""
        while True:
            new = _shots_in(self._folder) - known
            for name in sorted(new, key=lambda name: _written(self._folder, name)):
                try:
                    shot = _load(self._folder, name, description)
                except _CutShort as error:
                    trouble = f"; {error}: write it under another name, and then rename it"
                    continue
                known.add(name)
                if shot is not None:
                    yield shot
                    deadline, trouble = monotonic() + self._timeout, ""
            if monotonic() > deadline:
                raise CameraError(f"no new image for {self._timeout:g} s in {self._folder}{trouble or _newest(self._folder)}")
            sleep(PAUSE)

    def _opened(self) -> Description:
        if self._description is None:
            raise CameraError(f"camera {self.name} is not open: call open() first")
        return self._description


def describe(folder: Path, description: Description) -> None:
    """Write ``camera.json``, atomically."""
    write_json(folder / DESCRIPTION, description.model_dump(mode="json"))


def write_pair(
    folder: Path, name: str, color: UInt8[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"], scale: float | None
) -> None:
    """Write a shot, each of its files atomically.

    Args:
        name: Not used before.
        color: RGB.
        depth: Metres; 0 where there is no reading.
        scale: Metres per count of a 16-bit image, as in ``camera.json``; what is too far for 16 bits has no reading. None to
            write metres.
    """
    if scale is None:
        buffer = io.BytesIO()
        np.save(buffer, depth.astype(np.float32))
        _write(folder / f"{name}{DEPTHS[1]}", buffer.getvalue())
    else:
        counts = np.round(depth / scale)
        _write(folder / f"{name}{DEPTHS[0]}", _png(np.where(counts > 65535, 0, counts).astype(np.uint16)))
    _write(folder / f"{name}{COLOR}", _png(cv2.cvtColor(color, cv2.COLOR_RGB2BGR)))


class _CutShort(Exception):
    """A file that is still being written, or was never finished."""


def _described(folder: Path) -> Description:
    path = folder / DESCRIPTION
    if not folder.is_dir():
        raise CameraError(f"there is no folder {folder}: start the camera's program, or check camera.folder")
    if not path.is_file():
        keys = ", ".join(Description.model_fields)
        raise CameraError(f"there is no {path}: the camera's program must write it, with {keys}")
    try:
        return Description.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise CameraError(f"{path}: {key + ': ' if key else ''}{' '.join(first['msg'].split())}") from None


def _shots_in(folder: Path) -> set[str]:
    """Names of the shots of which both files are there."""
    try:
        files = set(os.listdir(folder))
    except FileNotFoundError:
        raise CameraError(f"the folder {folder} is gone: start the camera's program again") from None
    names = {file.removesuffix(COLOR) for file in files if file.endswith(COLOR)}
    return {name for name in names if any(name + ending in files for ending in DEPTHS)}


def _written(folder: Path, name: str) -> float:
    """When a shot was written, seconds; 0 if it is gone."""
    try:
        return (folder / f"{name}{COLOR}").stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _newest(folder: Path) -> str:
    ages = {name: time() - _written(folder, name) for name in _shots_in(folder)}
    if not ages:
        return ", and no old one either: check that the camera's program runs, and that it writes there"
    name = min(ages, key=ages.__getitem__)
    return (
        f"; the newest, {name}, is {ages[name]:.1f} s old: check that the camera's program runs, and gives each shot a new name"
    )


def _load(folder: Path, name: str, description: Description) -> tuple[np.ndarray, np.ndarray] | None:
    """Colour, and depth in metres; None if the files are gone.

    Raises:
        _CutShort: A file does not have its end yet.
        CameraError: A file is not what it should be.
    """
    try:
        color = cv2.cvtColor(_image(folder / f"{name}{COLOR}", cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        counts, metres = (folder / f"{name}{ending}" for ending in DEPTHS)
        depth = _counts(counts) * np.float32(description.depth_scale) if counts.exists() else _metres(metres)
    except FileNotFoundError:
        return None
    size = (description.height, description.width)
    if not color.shape[:2] == depth.shape == size:
        (height, width), (rows, cols) = color.shape[:2], depth.shape
        raise CameraError(
            f"shot {name} in {folder} has {width} x {height} pixels of colour and {cols} x {rows} of depth, and {DESCRIPTION} "
            f"says {description.width} x {description.height}: all three must be equal"
        )
    return color, depth


def _counts(path: Path) -> np.ndarray:
    image = _image(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise CameraError(f"{path} must be an image of one channel of 16 bits (found {image.dtype}, shape {image.shape})")
    return image


def _metres(path: Path) -> np.ndarray:
    try:
        depth = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
    except FileNotFoundError:
        raise
    except Exception:  # numpy parses the head of a file as Python, and unpacks an archive
        raise _CutShort(f"{path} is cut short, or no array") from None
    if not isinstance(depth, np.ndarray):
        raise CameraError(f"{path} must be one array (found an archive of several): write it with numpy.save")
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise CameraError(f"{path} must be an array of rows and columns of floats (found {depth.dtype}, shape {depth.shape})")
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _image(path: Path, mode: int) -> np.ndarray:
    data = path.read_bytes()
    if PNG_END not in data:
        raise _CutShort(f"{path} is cut short, or no PNG")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise CameraError(f"{path} is damaged: it cannot be decoded")
    return image


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as partial:
        partial.write_bytes(data)
