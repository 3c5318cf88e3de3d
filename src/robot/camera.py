"""A perspective RGB-D camera with the noise of a stereo sensor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import Rotation

from see2act.robot.randomization import Light, Randomization
from see2act.robot.simulation import Simulation
from see2act.robot.types import NotNegative, Positive, RobotError, is_triple

NEAR, FAR = 0.1, 3.0
"""Clipping planes, metres."""
LARGEST = 8192
"""Pixels of the longer side of an image."""


@dataclass(frozen=True)
class DepthNoise:
    """Errors of a stereo depth sensor (Intel RealSense D415).

    Depth z comes from disparity d = f b / z, so an error in d causes an error in z that grows with z squared.

    Args:
        baseline: Distance between the two imagers, metres (D415: 0.055).
        focal: Focal length in pixels at the sensor's own resolution (D415 at 1280 x 720: about 930).
        sigma: Standard deviation of the disparity, pixels (Intel's tuning guide: 0.08 with texture).
        step: Quantisation of the disparity, pixels (D4 chips: 1/32).
        blur: Pixels over which the error is correlated, as in block matching.
        edge_loss: Depth jump to a neighbour in metres, above which a pixel may lose its reading.
        edge_rate: Probability that such a pixel loses its reading.
        grazing: Angle in radians between a ray and the surface normal, above which a pixel may lose its reading. The error
            of such readings grows as 1 / (pi / 2 - angle)^2 (Nguyen, Izadi and Lovell 2012, whose model passes 8 mm at 80
            degrees), and block matching rejects them.
        grazing_rate: Probability that such a pixel loses its reading.
        transparent_rate: Probability that a pixel on a transparent object has no reading; otherwise it reads the floor behind.
    """

    baseline: Positive = 0.055
    focal: Positive = 930.0
    sigma: NotNegative = 0.08
    step: Positive = 1 / 32
    blur: NotNegative = 1.0
    edge_loss: NotNegative = 0.02
    edge_rate: NotNegative = 0.5
    grazing: NotNegative = 1.4
    grazing_rate: NotNegative = 0.8
    transparent_rate: NotNegative = 0.5

    def __call__(
        self, depth: Float[np.ndarray, "h w"], incidence: Float[np.ndarray, "h w"], rng: np.random.Generator
    ) -> Float[np.ndarray, "h w"]:
        """Sensed depth in metres; 0 where there is no reading.

        Args:
            depth: Exact depth, metres.
            incidence: Angle in radians between each pixel's ray and the normal of the surface that it meets.
            rng: Source of all randomness here.
        """
        noise: np.ndarray = rng.standard_normal(depth.shape, np.float32)
        if self.blur > 0:
            noise = cv2.GaussianBlur(noise, (0, 0), self.blur)
            noise = noise / noise.std()
        disparity = self.focal * self.baseline / depth + self.sigma * noise
        disparity = np.round(disparity / self.step) * self.step
        sensed = (self.focal * self.baseline / disparity).astype(np.float32)
        kernel = np.ones((3, 3), np.uint8)
        jump = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)
        sensed[(jump > self.edge_loss) & (rng.random(depth.shape) < self.edge_rate)] = 0
        sensed[(incidence > self.grazing) & (rng.random(depth.shape) < self.grazing_rate)] = 0
        return sensed


@dataclass(frozen=True)
class Camera:
    """The pose of the camera, and what it measures.

    Args:
        name: Name used in the configuration.
        position: World position, metres.
        target: World point at the centre of the image, metres.
        up: World direction that points up in the image.
        width, height: Image size, pixels.
        focal: Focal length, pixels.
        noise: Errors of the depth.
        crop: First row, first column, number of rows and number of columns of the part that is rendered; None for all.
        randomize: Whether every scene has another error of the camera, another light and another noise.
        randomization: Their ranges.
        light: What the scene is lit by.
        depth_scale: The sensor's depth as a share of the true one: what is left of an error that a calibration corrects.

    Raises:
        RobotError: The image has no pixels, the focal length is not above 0, or the viewing direction is undefined.
    """

    name: str
    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    width: int
    height: int
    focal: float
    noise: DepthNoise
    crop: tuple[int, int, int, int] | None = None
    randomize: bool = False
    randomization: Randomization = field(default_factory=Randomization)
    light: Light = field(default_factory=Light)
    depth_scale: float = 1.0

    def __post_init__(self) -> None:
        if not (1 <= min(self.width, self.height) <= max(self.width, self.height) <= LARGEST and self.focal > 0):
            raise RobotError(
                f"camera.width={self.width}, camera.height={self.height} and camera.focal={self.focal}: give at least 1 pixel "
                f"each, {LARGEST} at most, and a focal length above 0"
            )
        with np.errstate(invalid="ignore"):
            known = all(map(is_triple, (self.position, self.target, self.up)))
            looks = known and bool(np.isfinite(self.pose).all())
        if not looks:
            raise RobotError(
                f"camera.position={self.position}, camera.target={self.target} and camera.up={self.up} give no view: each must "
                "be three numbers, position and target apart, and up not along the view"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the rendered image."""
        return self.crop[2:] if self.crop else (self.height, self.width)

    def cropped_to(self, points: Float[np.ndarray, "n 3"], margin: int = 4) -> Camera:
        """This camera, cropped to the part of its image that shows the given world points, plus a margin in pixels.

        The part shows them from wherever :meth:`randomized` may put the camera. Not cropped if a point is behind the camera or
        no point is in view.
        """
        whole = replace(self, crop=None)
        x, y, z = (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(self.pose).T)[:, :3].T
        if z.min() < NEAR:
            return whole
        cols, rows = (whole.focal * axis / z + centre for axis, centre in zip((x, y), whole.intrinsics[:2, 2], strict=True))
        if self.randomize:  # an angle takes more pixels away from the image's centre
            obliquity = 1 + float(((x**2 + y**2) / z**2).max())
            margin += int(np.ceil(self.focal * obliquity * self.randomization.parallax(float(z.min()))))
        top, left = (max(0, int(np.floor(v.min())) - margin) for v in (rows, cols))
        height = min(self.height, int(np.ceil(rows.max())) + margin) - top
        width = min(self.width, int(np.ceil(cols.max())) + margin) - left
        return replace(self, crop=(top, left, height, width)) if min(height, width) > 0 else whole

    def randomized(self, rng: np.random.Generator) -> Camera:
        """The camera as it really is in one scene: elsewhere, in another light, with other noise. Itself if not ``randomize``.

        Its images are the ones that are taken. Whoever projects them only knows the pose of this one.
        """
        if not self.randomize:
            return self
        drawn = self.randomization.draw(rng)
        turn = Rotation.from_rotvec(drawn.rotation).as_matrix()
        position = self.position + drawn.position
        noise = replace(
            self.noise,
            sigma=self.noise.sigma * drawn.sigma,
            edge_rate=min(1.0, self.noise.edge_rate * drawn.edge_rate),
            grazing_rate=min(1.0, self.noise.grazing_rate * drawn.grazing_rate),
        )
        return replace(
            self,
            position=_triple(position),
            target=_triple(position + turn @ np.subtract(self.target, self.position)),
            up=_triple(turn @ self.up),
            noise=noise,
            light=drawn.light,
            depth_scale=self.depth_scale * drawn.depth_scale,
        )

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Pinhole matrix in pixels. The centre of a pixel is at its index plus 0.5.

        TinyRenderer counts rows from below and samples at the upper left corner of a pixel, hence the offsets of 0.5.
        """
        top, left = self.crop[:2] if self.crop else (0, 0)
        centre = self.width / 2 + 0.5 - left, self.height / 2 - 0.5 - top
        return np.array([[self.focal, 0, centre[0]], [0, self.focal, centre[1]], [0, 0, 1]])

    @property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Camera to world; in the camera's frame x is right, y down and z forward."""
        forward = _unit(np.subtract(self.target, self.position))
        right = _unit(np.cross(forward, self.up))
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = self.position
        return pose

    def sense(
        self, depth: Float[np.ndarray, "h w"], transparent: Bool[np.ndarray, "h w"], rng: np.random.Generator
    ) -> Float[np.ndarray, "h w"]:
        """Depth in metres as the sensor reports it; 0 where it has no reading.

        Args:
            depth: Exact depth, metres.
            transparent: True on transparent objects. A pixel there has no reading or reads the bin's floor.
            rng: Source of all randomness here.
        """
        if transparent.any():
            depth = np.where(transparent, self.floor_depth(), depth).astype(np.float32)
        sensed = self.noise(depth, self.incidence(depth), rng)
        if transparent.any():
            sensed[transparent & (rng.random(depth.shape) < self.noise.transparent_rate)] = 0
        return sensed * self.depth_scale

    def floor_depth(self) -> Float[np.ndarray, "h w"]:
        """Depth in metres at which each pixel's ray meets the plane z = 0; ``FAR`` where it does not."""
        rows, cols = (np.arange(n) + 0.5 for n in self.shape)
        x = ((cols - self.intrinsics[0, 2]) / self.focal)[None]
        y = ((rows - self.intrinsics[1, 2]) / self.focal)[:, None]
        down = -(self.pose[2, 0] * x + self.pose[2, 1] * y + self.pose[2, 2])
        return np.where(down > 1e-3, self.pose[2, 3] / np.maximum(down, 1e-3), FAR)

    def incidence(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Angle in radians between each pixel's ray and the normal of the surface that it meets."""
        dv, du = _slope(depth, 0), _slope(depth, 1)
        rows, cols = (np.arange(n, dtype=np.float32) + 0.5 for n in depth.shape)
        x, y = cols - np.float32(self.intrinsics[0, 2]), (rows - np.float32(self.intrinsics[1, 2]))[:, None]
        # The dot product of the ray (x, y, f) / f and the normal (-f du, -f dv, z + x du + y dv) is z.
        normal = np.sqrt((self.focal * du) ** 2 + (self.focal * dv) ** 2 + (depth + x * du + y * dv) ** 2)
        ray = np.sqrt(x**2 + y**2 + self.focal**2) / self.focal
        return np.arccos((depth / (normal * ray)).clip(0, 1))

    def render(
        self, simulation: Simulation
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        """Colour, exact depth in metres, and the id of the body seen in each pixel (-1 for none)."""
        client = simulation.client
        view = client.computeViewMatrix(self.position, self.target, self.up)
        rows, cols = self.shape
        # The light is always given, since the renderer keeps the one that it was given last.
        _, _, color, z, body = client.getCameraImage(
            *(cols, rows, view, self._projection()),
            lightDirection=self.light.direction,
            lightColor=self.light.color,
            lightAmbientCoeff=self.light.ambient,
            lightDiffuseCoeff=self.light.diffuse,
            shadow=0,  # it would be that of hidden bodies, too
            renderer=client.ER_TINY_RENDERER,
        )
        z = np.asarray(z, np.float64).reshape(rows, cols)
        depth = (FAR * NEAR / (FAR - (FAR - NEAR) * z)).astype(np.float32)
        color = np.asarray(color, np.uint8).reshape(rows, cols, 4)[..., :3]
        return color, depth, np.asarray(body).reshape(rows, cols)

    def _projection(self) -> list[float]:
        """OpenGL projection matrix of the pinhole camera, column-major. For a crop it is off-centre."""
        rows, cols = self.shape
        top, left = self.crop[:2] if self.crop else (0, 0)
        below = self.height - top - rows
        return [
            *(2 * self.focal / cols, 0, 0, 0),
            *(0, 2 * self.focal / rows, 0, 0),
            *(1 - (self.width - 2 * left) / cols, 1 - (self.height - 2 * below) / rows),
            *(-(FAR + NEAR) / (FAR - NEAR), -1),
            *(0, 0, -2 * FAR * NEAR / (FAR - NEAR), 0),
        ]


def _slope(depth: np.ndarray, axis: int) -> np.ndarray:
    """Depth change per pixel along an axis, to the neighbour where it is smaller. At a depth edge that one is on the same
    surface."""
    steps = np.diff(depth, axis=axis)
    before = np.concatenate([np.take(steps, [0], axis), steps], axis)
    after = np.concatenate([steps, np.take(steps, [-1], axis)], axis)
    return np.where(np.abs(before) < np.abs(after), before, after)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
