"""What a user would try before learning anything: the colour for suction, the heights for grasping."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from see2act.attempt import Affordances
from see2act.robot.simulated import SimulatedRobot

FLAT = 0.005
"""Metres above the floor below which it is taken for the floor."""
WINDOW = 0.027
"""Metres over which colour is averaged, one and a half cups: the best of a few, on develop scenes."""
PAD = 0.022
"""Metres across the pads of a gripper."""
FINGER = 0.022
"""Metres along the jaws that an open finger takes up."""
BEYOND = 1.0
"""Metres; stands for a side that is farther than an open finger."""
HOPELESS = -1.0
CENTRING = 0.001
"""Metres that a place amid an object is worth more than one at its end: what fits as well there slips out of the jaws."""


def heuristic(robot: SimulatedRobot, angles: int) -> Affordances:
    """The rule for a robot's tool."""
    pixel, half = robot.workspace.pixel, robot.half_opening

    def rule(color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "A H W"]:
        return antipodal(height, angles, pixel, half) if half else colorful(color, height, pixel)

    return rule


def colorful(color: UInt8[np.ndarray, "H W 3"], height: Float[np.ndarray, "H W"], pixel: float) -> Float[np.ndarray, "1 H W"]:
    """How far the colour under and around a cup is from the floor's, in RGB (0..255)."""
    flat = height < FLAT
    floor = np.median(color[flat if flat.any() else ...].reshape(-1, 3), axis=0)
    side = max(1, round(WINDOW / pixel))
    return cv2.blur(np.linalg.norm(color - floor, axis=-1), (side, side))[None]


def antipodal(height: Float[np.ndarray, "H W"], angles: int, pixel: float, half: float) -> Float[np.ndarray, "A H W"]:
    """Metres by which an object stands above where the fingers come down, less how far it is from a fit between the pads.

    Along the jaws the height must fall to less than half of what it is in the middle, on both sides, within ``half`` metres:
    there the pads meet the object. It fits where both sides are equally far, and straight across the pads; of
    places that fit alike, the middle of an object is better.
    """
    return np.stack([_across(height, k * np.pi / angles, pixel, half) for k in range(angles)])


def _across(height: np.ndarray, angle: float, pixel: float, half: float) -> np.ndarray:
    """The rule for one angle: the heights are turned so that the jaws lie along the rows."""
    rows, cols = height.shape
    side = int(np.ceil(np.hypot(rows, cols)))
    # A positive angle of OpenCV's turns an image counter-clockwise; here what lies at ``angle`` becomes horizontal.
    there = cv2.getRotationMatrix2D(((cols - 1) / 2, (rows - 1) / 2), -np.degrees(angle), 1.0)
    there[:, 2] += (side - cols) / 2, (side - rows) / 2
    turned = cv2.warpAffine(height, there, (side, side), flags=cv2.INTER_NEAREST)
    room, finger, pad = round(half / pixel), round(FINGER / pixel), round(PAD / pixel)
    under_pad = np.ones((pad, 1), np.uint8)
    score, sides = turned.astype(float), []
    for sign in (-1, 1):
        edge = np.full(turned.shape, BEYOND)
        for k in range(room, 0, -1):
            edge[np.roll(turned, -sign * k, axis=1) < turned / 2] = k * pixel
        farthest = cv2.dilate(edge, under_pad)
        sides.append(farthest)
        score -= farthest - cv2.erode(edge, under_pad)
    fingers = cv2.dilate(turned, np.ones((pad, finger), np.uint8))
    score -= np.maximum(*(np.roll(fingers, sign * (room + finger // 2), axis=1) for sign in (-1, 1)))
    score -= np.abs(sides[0] - sides[1])
    score += CENTRING * cv2.blur((turned >= FLAT).astype(float), (2 * pad + 1, 4 * pad + 1))
    score[(np.maximum(*sides) >= BEYOND) | (turned < FLAT)] = HOPELESS
    return cv2.warpAffine(score, cv2.invertAffineTransform(there), (cols, rows), flags=cv2.INTER_NEAREST)
