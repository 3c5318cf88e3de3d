"""Predicted picks in a picture: over the image, and on the heightmap."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import UInt8

from see2act.prediction.predict import Prediction, ScoredPick

SHARE = 0.45
"""Of the heatmap in a picture's colour."""
MARK = (255, 255, 255)
EDGE = (0, 0, 0)


def picture(color: UInt8[np.ndarray, "h w 3"], prediction: Prediction) -> UInt8[np.ndarray, "h W 3"]:
    """The image with heatmap and numbered picks; beside it the same on the heightmap, enlarged to the same height."""
    scores = np.zeros(color.shape[:2], np.float32)
    seen = prediction.source >= 0
    scores.ravel()[prediction.source[seen]] = prediction.scores[seen]
    # A cell is wider than the one image pixel it was seen in.
    image = _heated(color, np.asarray(cv2.dilate(scores, np.ones((5, 5), np.uint8))))
    for number, pick in enumerate(prediction.picks, start=1):
        _mark(image, (pick.u, pick.v), number, _direction_in_image(pick, prediction))
    factor = color.shape[0] / prediction.heightmap.height.shape[0]
    size = (round(prediction.heightmap.height.shape[1] * factor), color.shape[0])
    enlarged = cv2.resize(prediction.heightmap.color, size, interpolation=cv2.INTER_NEAREST)
    above = _heated(enlarged, cv2.resize(prediction.scores.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    for number, pick in enumerate(prediction.picks, start=1):
        along = None
        if pick.angle is not None:
            reach = prediction.footprint[0] / prediction.workspace.pixel * factor
            along = np.array([math.cos(pick.angle), -math.sin(pick.angle)]) * reach
        _mark(above, (round((pick.col + 0.5) * factor), round((pick.row + 0.5) * factor)), number, along)
    return np.concatenate([image, above], axis=1)


def _heated(color: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Colour under the heatmap: blue where failure is expected, red where success, none where nothing may be picked."""
    heat = cv2.cvtColor(cv2.applyColorMap((scores * 255).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    cover = (SHARE * (scores > 0))[..., None]
    return np.asarray(color * (1 - cover) + heat * cover).astype(np.uint8)


def _direction_in_image(pick: ScoredPick, prediction: Prediction) -> np.ndarray | None:
    """Pixels from the pick to where a jaw ends."""
    if pick.angle is None:
        return None
    rotation = prediction.pose[:3, :3]
    way = rotation.T @ np.array([math.cos(pick.angle), math.sin(pick.angle), 0]) * prediction.footprint[0]
    start = np.array(pick.position_camera)
    return _pinhole(start + way, prediction) - _pinhole(start, prediction)


def _pinhole(point: np.ndarray, prediction: Prediction) -> np.ndarray:
    seen = prediction.intrinsics @ point
    return np.asarray(seen[:2] / seen[2])


def _mark(image: np.ndarray, at: tuple[int, int], number: int, along: np.ndarray | None) -> None:
    for colour, width in ((EDGE, 4), (MARK, 2)):
        if along is not None:
            start, end = ([round(float(n)) for n in np.add(at, sign * along)] for sign in (-1, 1))
            cv2.line(image, start, end, colour, width, cv2.LINE_AA)
        cv2.circle(image, at, 5, colour, width, cv2.LINE_AA)
        cv2.putText(image, str(number), (at[0] + 7, at[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv2.LINE_AA)
