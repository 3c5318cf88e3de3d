"""What is in a file of numbers or an image, before it is known what it means."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from see2act.errors import UserError


def read(path: Path) -> Any:
    """Nested lists, dictionaries or an array, from text, ``.npy``, JSON or YAML; nothing in it is executed.

    Raises:
        UserError: It cannot be read.
    """
    try:
        if path.suffix == ".npy":
            return _array(path)
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix == ".json":
            return json.loads(text)
        if path.suffix in (".yaml", ".yml"):
            return yaml.load(text.removeprefix("%YAML:1.0"), _Yaml)
        lines = [line for line in text.replace(",", " ").splitlines() if line.split("#")[0].strip()]
        return np.loadtxt(lines, ndmin=2) if lines else np.empty(0)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise UserError(f"{path} cannot be read ({' '.join(str(error).split())}): write a row of numbers a line") from None


def _array(path: Path) -> np.ndarray:
    """The array in a ``.npy``; nothing in it is executed.

    Raises:
        ValueError: It is none, or an archive of several, whatever its name.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # numpy parses the head of a file as Python, and unpacks an archive
        raise ValueError(str(error) or type(error).__name__) from None
    if not isinstance(array, np.ndarray):
        raise ValueError("it holds several arrays")
    return array


class _Yaml(yaml.SafeLoader):
    """YAML as OpenCV and ROS write it."""


_Yaml.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True))


def read_image(path: Path) -> Any:
    """An image as it is kept, from ``.npy``, EXR or whatever OpenCV reads; None if that reads none.

    Raises:
        UserError: It cannot be read.
    """
    try:
        if path.suffix == ".npy":
            return _array(path)
        return _exr(path) if path.suffix.lower() == ".exr" else decoded(path, cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(f"{path} cannot be read ({' '.join(str(error).split())}): save it anew as .npy or 16-bit PNG") from None


def decoded(path: Path, flags: int) -> np.ndarray | None:
    """What OpenCV makes of an image; None where it makes nothing of it."""
    try:
        return cv2.imread(str(path), flags)
    except cv2.error:  # it says that it has a billion pixels, for example
        return None


def _exr(path: Path) -> np.ndarray:
    """Its first channel, such as Blender's depth."""
    try:
        import OpenEXR
    except ImportError:
        raise UserError(f"{path} needs the package OpenEXR: pip install 'see2act[exr]', or save the depth as .npy") from None
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = list(file.channels().values())
    if not channels:
        raise ValueError("it has no channel")
    return np.asarray(channels[0].pixels)
