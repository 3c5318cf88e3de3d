"""The five vision tasks: how each one labels a view of the bin (paper, section III-B).

Every task can make its labels from the simulator's truth (``truth``) or from what a real robot could see (``vision``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Bool, Float
from scipy import ndimage

from see2act.errors import ConfigError
from see2act.robot.types import Heightmap, NotNegative

LONGEST = 1.0
"""Metres: of a window or radius."""
LabelSource = Literal["truth", "vision"]


@dataclass(frozen=True)
class View:
    """One observation of the bin: what was sensed, the truth, and the empty bin."""

    sensed: Heightmap
    clean: Heightmap
    body: np.ndarray
    """Id of the object in each cell, (H, W); -1 for none."""
    background: Heightmap

    @classmethod
    def of_a_block(cls, shape: tuple[int, int]) -> View:
        """A white block of 3 cm on a black floor, for trying out a task."""
        block = np.zeros(shape, bool)
        block[tuple(slice(side // 3, side - side // 3) for side in shape)] = True
        empty, full = (
            Heightmap(
                np.repeat(255 * seen[..., None], 3, axis=2).astype(np.uint8), seen * np.float32(0.03), np.ones(shape, bool)
            )
            for seen in (np.zeros(shape, bool), block)
        )
        return cls(full, full, np.where(block, 0, -1), empty)


class Task(ABC):
    """A vision task: a binary label for every pixel.

    Args:
        pixel: Metres per pixel.

    Raises:
        ConfigError: ``pixel`` is not above 0.
    """

    tolerance = 0
    """Pixels by which a prediction may be off a label and still count as correct."""

    def __init__(self, pixel: float):
        if not pixel > 0:
            raise ConfigError(f"task.label.pixel={pixel} must be above 0: leave it at workspace.pixel")
        self.pixel = pixel

    def label(self, view: View, source: LabelSource) -> Bool[np.ndarray, "H W"]:
        """The label map of a view, from ``truth`` or from ``vision``."""
        return self.truth(view) if source == "truth" else self.vision(view)

    @abstractmethod
    def truth(self, view: View) -> Bool[np.ndarray, "H W"]:
        """Labels from noise-free images and object masks."""

    @abstractmethod
    def vision(self, view: View) -> Bool[np.ndarray, "H W"]:
        """Labels from what a real robot could sense."""

    def pixels(self, metres: float) -> int:
        """Convert a length to whole pixels, at least 1.

        Raises:
            ConfigError: It is longer than any bin.
        """
        if metres > LONGEST:
            raise ConfigError(f"a length of {metres:g} m is more than {LONGEST:g} m: give lengths in metres, within the bin")
        return max(1, round(metres / self.pixel))

    def window(self, metres: float) -> int:
        """Convert the side of a window to pixels, an odd number so that one pixel is in the middle."""
        return self.pixels(metres) // 2 * 2 + 1


class Edge(Task):
    """Canny edges in any channel of the colour image. (In grey, a green object can be as bright as the floor.)

    Args:
        pixel: Metres per pixel.
        low, high: Canny's hysteresis thresholds, of 3 x 3 Sobel sums: 8 times the change in grey levels per pixel.
        blur: Standard deviation of the Gaussian that is applied first, pixels.
    """

    tolerance = 2

    def __init__(self, pixel: float, low: NotNegative, high: NotNegative, blur: Annotated[float, Gt(0), Le(100)]):
        super().__init__(pixel)
        self._low, self._high, self._blur = low, high, blur

    def truth(self, view: View) -> np.ndarray:
        return self._canny(view.clean)

    def vision(self, view: View) -> np.ndarray:
        return self._canny(view.sensed)

    def _canny(self, heightmap: Heightmap) -> np.ndarray:
        smooth = cv2.GaussianBlur(heightmap.color, (0, 0), self._blur)
        return np.logical_or.reduce([cv2.Canny(channel, self._low, self._high) > 0 for channel in cv2.split(smooth)])


class Corner(Task):
    """Harris corners in any channel of the colour image, as discs.

    Args:
        pixel: Metres per pixel.
        window: Side of the neighbourhood whose gradients are compared, metres.
        k: Harris's constant.
        threshold: Smallest response that counts, as a share of the image's strongest response.
        radius: Radius of the disc around each corner, metres.
    """

    tolerance = 2

    def __init__(self, pixel: float, window: NotNegative, k: float, threshold: float, radius: NotNegative):
        super().__init__(pixel)
        self._window, self._k, self._threshold, self._radius = window, k, threshold, radius

    def truth(self, view: View) -> np.ndarray:
        return self._harris(view.clean)

    def vision(self, view: View) -> np.ndarray:
        return self._harris(view.sensed)

    def _harris(self, heightmap: Heightmap) -> np.ndarray:
        channels = cv2.split(heightmap.color.astype(np.float32))
        response = np.max([cv2.cornerHarris(channel, self.window(self._window), 3, self._k) for channel in channels], axis=0)
        size = 2 * self.pixels(self._radius) + 1
        peak = (response == ndimage.maximum_filter(response, size)) & (response > self._threshold * response.max())
        return discs(np.argwhere(peak), peak.shape, self.pixels(self._radius))


class Foreground(Task):
    """Object or background.

    Args:
        pixel: Metres per pixel.
        height: Metres above the empty bin from which a pixel counts as object.
        color: RGB distance (channels 0..255) to the empty bin from which a pixel counts as object, whatever its height.
        opening: Specks smaller than this are removed as noise, metres.
    """

    def __init__(self, pixel: float, height: float, color: NotNegative, opening: NotNegative):
        super().__init__(pixel)
        self._height, self._color, self._opening = height, color, opening

    def truth(self, view: View) -> np.ndarray:
        return view.body >= 0

    def vision(self, view: View) -> np.ndarray:
        higher = view.sensed.height - view.background.height > self._height
        difference = view.sensed.color.astype(float) - view.background.color
        # Colours of pixels that one of the two views does not show are filled in, so only the height counts there.
        seen = view.sensed.valid & view.background.valid
        painted = (np.linalg.norm(difference, axis=-1) > self._color) & seen
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (self.window(self._opening),) * 2)
        return cv2.morphologyEx((higher | painted).astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0


class Center(Task):
    """Object centres, as discs: the middle of each object mask (``truth``) or connected piece of foreground (``vision``).

    Args:
        pixel: Metres per pixel.
        radius: Radius of the disc, metres.
        smallest: Area in square metres below which a piece does not count as an object.
        foreground: Finds the foreground for ``vision``.
    """

    tolerance = 2

    def __init__(self, pixel: float, radius: NotNegative, smallest: NotNegative, foreground: Foreground):
        super().__init__(pixel)
        self._radius, self._smallest, self._foreground = radius, smallest, foreground

    def truth(self, view: View) -> np.ndarray:
        masks = [view.body == body for body in np.unique(view.body[view.body >= 0])]
        return self._discs(masks, view.body.shape)

    def vision(self, view: View) -> np.ndarray:
        foreground = self._foreground.vision(view)
        pieces, count = ndimage.label(foreground)
        return self._discs([pieces == i for i in range(1, count + 1)], foreground.shape)

    def _discs(self, masks: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        large = [mask for mask in masks if mask.sum() * self.pixel**2 >= self._smallest]
        middles = np.array([np.argwhere(mask).mean(0) for mask in large]).round().astype(int).reshape(-1, 2)
        return discs(middles, shape, self.pixels(self._radius))


class Normal(Task):
    """Flat surfaces of objects that face up, against gravity.

    Args:
        pixel: Metres per pixel.
        window: Side of the neighbourhood that a plane is fitted to, metres.
        tilt: Largest angle between the plane's normal and the vertical, radians.
        roughness: Largest root mean square distance from the plane on noise-free depth, metres.
        sensed_roughness: Largest root mean square distance from the plane on sensed depth, which has noise, metres.
        foreground: Excludes the bin's floor, which is flat and faces up but is not an object.
    """

    def __init__(
        self,
        pixel: float,
        window: NotNegative,
        tilt: NotNegative,
        roughness: NotNegative,
        sensed_roughness: NotNegative,
        foreground: Foreground,
    ):
        super().__init__(pixel)
        self._window, self._tilt = window, tilt
        self._roughness, self._sensed_roughness = roughness, sensed_roughness
        self._foreground = foreground

    def truth(self, view: View) -> np.ndarray:
        return self._flat(view.clean.height, self._roughness) & self._foreground.truth(view)

    def vision(self, view: View) -> np.ndarray:
        return self._flat(view.sensed.height, self._sensed_roughness) & self._foreground.vision(view)

    def _flat(self, height: Float[np.ndarray, "H W"], roughness: float) -> np.ndarray:
        tilt, rms = plane_fit(height, self.pixel, self.pixels(self._window / 2))
        return (tilt < self._tilt) & (rms < roughness)


def plane_fit(height: Float[np.ndarray, "H W"], pixel: float, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Fit a least-squares plane around every pixel.

    Args:
        height: Metres.
        pixel: Metres per pixel.
        radius: Pixels. The neighbourhood is a square with sides of 2 radius + 1.

    Returns:
        The angle between each plane's normal and the vertical in radians, and the root mean square distance from the plane in
        metres.
    """
    offsets = np.arange(-radius, radius + 1) * pixel
    n = len(offsets) ** 2
    second = float((offsets**2).sum() * len(offsets))
    h = height.astype(np.float64)
    ones = np.ones_like(offsets)
    mean = _correlate(h, ones, ones) / n
    slope_x = _correlate(h, ones, offsets) / second
    slope_y = _correlate(h, offsets, ones) / second
    variance = _correlate(h * h, ones, ones) / n - mean**2 - (slope_x**2 + slope_y**2) * second / n
    return np.arctan(np.hypot(slope_x, slope_y)), np.sqrt(np.maximum(variance, 0))


def discs(centres: np.ndarray, shape: tuple[int, ...], radius: int) -> Bool[np.ndarray, "H W"]:
    """A map that is True within ``radius`` pixels of any of the ``centres``, (n, 2) rows and columns."""
    label = np.zeros(shape, np.uint8)
    for row, col in centres:
        cv2.circle(label, (int(col), int(row)), radius, 1, thickness=-1)
    return label > 0


def _correlate(image: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    return ndimage.correlate1d(ndimage.correlate1d(image, down, axis=0, mode="nearest"), across, axis=1, mode="nearest")
