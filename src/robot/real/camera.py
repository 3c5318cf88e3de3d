"""The interface of depth cameras at a station."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from see2act.robot.types import RobotError


class CameraError(RobotError):
    """A camera that does not answer, is not the one of the station, or lacks a library. The message says what to do."""


@dataclass(frozen=True)
class Frame:
    """An RGB-D image: colour and depth of the same pixels, without lens distortion."""

    color: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    depth: Float[np.ndarray, "h w"]
    """Metres along the optical axis, float32; 0 where there is no reading. As the camera gives it, without the station's
    correction."""


class DepthCamera(ABC):
    """A camera that gives colour and depth of the same pixels. To add another one, subclass this.

    Building one must be cheap and must not touch the device: a configuration is checked by building its parts.
    """

    @abstractmethod
    def open(self) -> None:
        """Connect. Called once, before everything else.

        Raises:
            CameraError: It is not there, or its library is not.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Safe to call twice, and without :meth:`open`."""

    @property
    @abstractmethod
    def serial(self) -> str:
        """The serial number, or another name of this one camera. A calibration belongs to it."""

    @property
    @abstractmethod
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Pinhole matrix of the frames, pixels. The centre of a pixel is at its index, as in OpenCV and librealsense."""

    @abstractmethod
    def read(self) -> Frame:
        """An image taken after this call, in which each pixel is the median of several readings.

        Raises:
            CameraError: No image came in time.
        """
