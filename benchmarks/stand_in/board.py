"""A calibration board in a rendered image."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from see2act.robot.real.board import Board, drawing

OVER = 4
"""Times that the board is drawn larger than the image, and then averaged: at edges of squares, pixels are grey."""
SQUARE = 160
"""Pixels of a square in the drawing."""
RIM = 0.01
"""Metres of white around the board."""
BLUR = 0.8
"""Pixels, of the lens."""
DARKEST, BRIGHTEST = 40, 190
"""Of black and of white print."""


def with_board(
    color: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    board: Board,
    pose: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Image and depth with a board in front of what they show.

    Args:
        color: RGB.
        depth: Metres along the optical axis.
        board: Its printed side is shown from wherever it is seen.
        pose: Board to camera, metres.
        intrinsics: Pinhole matrix, pixels; the centre of a pixel is at its index.
    """
    rows, cols = depth.shape
    rim = round(SQUARE * RIM / board.square)
    drawn = cv2.copyMakeBorder(drawing(board, SQUARE), rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
    scale = board.square / SQUARE
    place = np.array([[scale, 0, scale * (0.5 - rim)], [0, scale, scale * (0.5 - rim)], [0, 0, 1]])
    to_image = intrinsics @ pose[:3, [0, 1, 3]] @ place
    outline = cv2.perspectiveTransform(
        np.array([[[0, 0], [drawn.shape[1], 0], [0, drawn.shape[0]], drawn.shape[::-1]]], float), to_image
    )[0]
    left, top = np.maximum(np.floor(outline.min(0)).astype(int) - 6, 0)
    right, bottom = np.minimum(np.ceil(outline.max(0)).astype(int) + 6, (cols, rows))
    if right <= left or bottom <= top:
        return color, depth
    enlarge = np.array([[OVER, 0, (OVER - 1) / 2 - OVER * left], [0, OVER, (OVER - 1) / 2 - OVER * top], [0, 0, 1]])
    size = OVER * int(right - left), OVER * int(bottom - top)
    print_, cover = (
        cv2.resize(
            cv2.warpPerspective(picture, enlarge @ to_image, size), None, fx=1 / OVER, fy=1 / OVER, interpolation=cv2.INTER_AREA
        )
        for picture in (drawn, np.full_like(drawn, 255))
    )
    part = np.s_[top:bottom, left:right]
    share = (cover / 255.0)[..., None]
    shade = DARKEST * share + (BRIGHTEST - DARKEST) * (print_ / 255.0)[..., None]
    color, depth = color.copy(), depth.copy()
    blended = shade + (1 - share) * color[part]
    color[part] = np.clip(cv2.GaussianBlur(blended, (0, 0), BLUR), 0, 255)
    v, u = np.mgrid[part]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T
    plane = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
    depth[part] = np.where(share[..., 0] > 0.5, plane, depth[part])
    return color, depth
