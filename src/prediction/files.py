"""Images and calibrations in the formats that people have them in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from see2act.errors import UserError
from see2act.prediction.contents import decoded, read, read_image

KNOWN = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady", "opencv")
"""Names of distortion models whose coefficients are OpenCV's, k1 k2 p1 p2 k3 and so on."""
MATRICES = ("camera_matrix", "intrinsic_matrix", "intrinsics", "k", "matrix")
COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distortion", "coeffs", "d")
POSES = ("camera_to_world", "pose", "matrix", "transform")
TRANSLATIONS = ("translation", "position", "t")
ROTATIONS = ("rotation", "orientation", "quaternion", "r", "q")
"""Keys under which calibration files have these things, in lower case."""
MOST = 1000
"""Numbers that are read of a calibration: more are something else."""
T = TypeVar("T")


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics."""

    matrix: Float[np.ndarray, "3 3"]
    """Pinhole, pixels; a pixel's centre is at its index."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients; empty where there is none."""
    size: tuple[int, int] | None = None
    """Columns and rows of the images that it is for, where the file says so."""

    def undistorted(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        """An image as a pinhole camera with the same matrix would have taken it.

        Args:
            image: (h, w) or (h, w, 3).
            interpolation: OpenCV's. A depth image must not be interpolated: ``cv2.INTER_NEAREST``.
        """
        if not self.distortion:
            return image
        size = (image.shape[1], image.shape[0])
        maps = cv2.initUndistortRectifyMap(self.matrix, np.array(self.distortion), np.eye(3), self.matrix, size, cv2.CV_32FC1)
        return np.asarray(cv2.remap(image, maps[0], maps[1], interpolation, borderMode=cv2.BORDER_CONSTANT))


def read_lens(given: str) -> Lens:
    """Intrinsics.

    Args:
        given: ``fx,fy,cx,cy``, or the path of a file. Text: three rows of three numbers, one row of nine, or one of four,
            fx fy cx cy. NumPy's ``.npy``: the same. JSON or YAML: a matrix, ``fx fy cx cy`` (or RealSense's ``ppx ppy``),
            ROS's ``camera_info``, OpenCV's ``camera_matrix``, or Open3D's ``intrinsic_matrix``; with distortion coefficients
            where there are any.

    Raises:
        UserError: It is none of these, or the lens is of a kind that OpenCV's coefficients do not describe.
    """
    if given.count(",") == 3 and not Path(given).exists():
        try:
            return _lens([float(word) for word in given.split(",")], "--intrinsics")
        except ValueError:
            raise UserError(f"--intrinsics {given} is neither a file nor fx,fy,cx,cy in pixels") from None
    path = there(Path(given), "--intrinsics")
    return _parsed(_lens, path)


def read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """A pose.

    Args:
        path: Text or ``.npy``: 4 x 4 or 3 x 4 numbers, or seven, x y z and a quaternion qx qy qz qw. JSON or YAML: a matrix,
            or a translation and a rotation (a quaternion x y z w, or 3 x 3), as in ROS's ``Transform`` and ``Pose``.

    Raises:
        UserError: It is none of these.
    """
    return _parsed(_pose, there(path, "--pose"))


def read_depth(path: Path, scale: float | None, option: str) -> Float[np.ndarray, "h w"]:
    """A depth image, metres; 0 or not finite where there is no reading.

    Args:
        path: 16-bit PNG, ``.npy``, TIFF, or EXR.
        scale: Units per metre. None for a file of floating-point numbers, which are metres.
        option: What the file was given as, for messages.

    Raises:
        UserError: It is none of these, or holds whole numbers and there is no scale.
    """
    there(path, option)
    depth = read_image(path)
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "iuf" or depth.dtype == np.uint8:
        shape = f"{depth.dtype} of shape {depth.shape}" if isinstance(depth, np.ndarray) else "no image"
        raise UserError(f"{path} is {shape}: depth must be a 16-bit PNG of one channel, or a .npy, TIFF or EXR of one")
    if scale is None and depth.dtype.kind != "f":
        raise UserError(f"{path} holds whole numbers: give --depth-scale, their number per metre (1000 for millimetres)")
    return np.asarray(depth, np.float32) / (scale or 1.0)


def read_color(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """A colour image as the sensor has it, RGB.

    Raises:
        UserError: It cannot be read.
    """
    # A camera's note of how it was held turns the colour image and not the depth.
    color = decoded(there(path, "--color"), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if color is None:
        raise UserError(f"{path} cannot be read as an image: give a PNG or JPEG")
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_BGR2RGB))


def there(path: Path, option: str) -> Path:
    """The path, of a file that exists.

    Raises:
        UserError: There is none.
    """
    if not path.is_file():
        raise UserError(f"{option} {path} is not there: give the path of a file")
    return path


# Intrinsics


def _lens(content: Any, name: str) -> Lens:
    if not isinstance(content, Mapping):
        return Lens(_pinhole(content, name))
    found = {str(key).lower(): value for key, value in content.items()}
    if {"fx", "fy"} <= found.keys():
        values = found["fx"], found["fy"], found.get("cx", found.get("ppx")), found.get("cy", found.get("ppy"))
        matrix = _pinhole(values, name)
    elif key := next((key for key in MATRICES if key in found), None):
        inner = found[key]
        if isinstance(inner, Mapping) and not {"data", "fx"} & inner.keys():
            return _lens(inner, name)
        known = isinstance(inner, Mapping) and "fx" in inner
        matrix = _lens(inner, name).matrix if known else _pinhole(_data(inner), name)
    else:
        return _lens(_only_part(found, name, ("color", "rgb")), name)
    return Lens(matrix, _distortion(found, name), _size(found))


def _pinhole(values: Any, name: str) -> Float[np.ndarray, "3 3"]:
    numbers = _numbers(values, name)
    if numbers.size == 4:
        fx, fy, cx, cy = numbers.ravel()
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if numbers.size == 12:  # a projection matrix
        return numbers.reshape(3, 4)[:, :3]
    if numbers.size != 9:
        raise UserError(f"{name} holds {numbers.size} numbers, and intrinsics are 9 (3 x 3, pixels) or 4 (fx fy cx cy)")
    matrix = numbers.reshape(3, 3)
    return matrix.T if not matrix[:2, 2].any() and matrix[2, :2].any() else matrix  # by columns, as Open3D writes it


def _distortion(found: Mapping[str, Any], name: str) -> tuple[float, ...]:
    key = next((key for key in COEFFICIENTS if key in found), None)
    values = _numbers(_data(found[key]), name).ravel() if key and found[key] is not None else np.zeros(0)
    if not values.any():
        return ()
    model = str(found.get("distortion_model", found.get("model", ""))).lower().removeprefix("distortion.")
    if model not in KNOWN:
        raise UserError(
            f"{name} describes the lens by {model}, which is not known here: undistort the images, and give coefficients of 0"
        )
    if len(values) not in (4, 5, 8, 12, 14):
        raise UserError(f"{name} has {len(values)} distortion coefficients: OpenCV has 4, 5, 8, 12 or 14 (k1 k2 p1 p2 k3 ...)")
    return tuple(float(value) for value in values)


def _size(found: Mapping[str, Any]) -> tuple[int, int] | None:
    for wide, high in (("image_width", "image_height"), ("width", "height")):
        if isinstance(found.get(wide), int) and isinstance(found.get(high), int):
            return found[wide], found[high]
    return None


# Poses


def _pose(content: Any, name: str) -> Float[np.ndarray, "4 4"]:
    if isinstance(content, Mapping):
        return _named_pose({str(key).lower(): value for key, value in content.items()}, name)
    numbers = _numbers(content, name)
    pose = np.eye(4)
    if numbers.size == 7:
        values = numbers.ravel()
        pose[:3, :3], pose[:3, 3] = _rotation(values[3:], name), values[:3]
    elif numbers.size in (12, 16):
        pose[: numbers.size // 4] = numbers.reshape(-1, 4)
    else:
        raise UserError(f"{name} holds {numbers.size} numbers, and a pose is 16 (4 x 4), 12 (3 x 4) or 7 (x y z qx qy qz qw)")
    return pose


def _named_pose(found: Mapping[str, Any], name: str) -> Float[np.ndarray, "4 4"]:
    at, turned = (next((key for key in keys if key in found), None) for keys in (TRANSLATIONS, ROTATIONS))
    if at and turned:
        pose = np.eye(4)
        place = _numbers(_ordered(found[at], "xyz"), name).ravel()
        if place.size != 3:
            raise UserError(f"{name}: its {at} holds {place.size} numbers, not 3: x y z in metres")
        pose[:3, :3], pose[:3, 3] = _rotation(_numbers(_ordered(found[turned], "xyzw"), name), name), place
        return pose
    if key := next((key for key in POSES if key in found), None):
        return _pose(_data(found[key]), name)
    return _pose(_only_part(found, name, ()), name)


def _rotation(values: np.ndarray, name: str) -> Float[np.ndarray, "3 3"]:
    if values.size == 9:
        return values.reshape(3, 3)
    if values.size != 4 or abs(np.linalg.norm(values) - 1) > 0.01:
        raise UserError(f"{name}: its rotation must be a quaternion of length 1, qx qy qz qw, or 3 x 3")
    return np.asarray(Rotation.from_quat(values.ravel()).as_matrix())


def _ordered(value: Any, keys: str) -> Any:
    if isinstance(value, Mapping):
        missing = [key for key in keys if key not in value]
        return value if missing else [value[key] for key in keys]
    return value


# Numbers


def _parsed(parse: Callable[[Any, str], T], path: Path) -> T:
    """What is in a file, unless it is nested without end, as YAML can be."""
    try:
        return parse(read(path), str(path))
    except RecursionError:
        raise UserError(f"{path} is nested too deeply: see docs/guides/images.md for the formats of calibrations") from None


def _numbers(values: Any, name: str) -> Float[np.ndarray, "*n"]:
    if not _are_few(values):
        raise UserError(f"{name} holds more than {MOST} numbers where a matrix is expected")
    try:
        numbers = np.array(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise UserError(f"{name} holds something else than numbers where a matrix is expected")
    return numbers


def _are_few(values: Any) -> bool:
    """Whether nested lists hold no more than ``MOST`` values. A list of YAML may hold itself."""
    left, count = [values], 0
    while left and count <= MOST:
        item = left.pop()
        count += 1
        left += item[: MOST + 1] if isinstance(item, list) else []
    return count <= MOST


def _data(value: Any) -> Any:
    return value["data"] if isinstance(value, Mapping) and "data" in value else value


def _only_part(found: Mapping[str, Any], name: str, preferred: tuple[str, ...]) -> Any:
    """The one dictionary below this one that the values must be in."""
    parts = {key: value for key, value in found.items() if isinstance(value, Mapping)}
    key = next((key for key in preferred if key in parts), next(iter(parts)) if len(parts) == 1 else None)
    if key is None:
        names = ", ".join(found) or "nothing"
        raise UserError(f"{name} has {names}, in which no calibration is recognised: see docs/guides/images.md for the formats")
    return parts[key]
