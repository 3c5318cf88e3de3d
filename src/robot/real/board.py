"""The ChArUco board that calibrates the camera: its size, a page to print, and how it is found in an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from see2act.files import replacing
from see2act.robot.types import RobotError

ENOUGH = 12
"""Corners from which on a view counts. Fewer lie in one part of the board, where its tilt is uncertain."""
MARKER = 0.75
"""Side of a marker as a share of a square's. It leaves the white rim of one bit that ArUco needs to find a marker."""
ENLARGED = 2
"""How many times larger images are made to find markers. Of rendered boards tilted by 40 to 45 degrees, 16 of 16 are then
found with 34 of 35 corners, and 11 of 16 without."""
DICTIONARY = cv2.aruco.DICT_5X5_100
PAGE = (210.0, 297.0)
"""A4, millimetres."""
RULER = 100.0
"""Length of the printed ruler, millimetres."""
MARGIN = 12.0
"""Millimetres at the page's border where nothing is drawn: many printers cannot."""


@dataclass(frozen=True)
class Board:
    """A chessboard with ArUco markers in its white squares.

    Its frame: origin at the outer corner of the top left square, x to the right and y down along the board, z into it.

    Args:
        columns, rows: Number of squares.
        square: Side of a square, metres, as measured on the print. Markers scale with it.

    Raises:
        RobotError: It has too few corners, more markers than the dictionary, or no size.
    """

    columns: int = 6
    rows: int = 8
    square: float = 0.020

    def __post_init__(self) -> None:
        corners, markers = (self.columns - 1) * (self.rows - 1), self.columns * self.rows // 2
        if min(self.columns, self.rows) < 3 or corners < ENOUGH or markers > 100 or not 0 < self.square < 1:
            raise RobotError(
                f"a board of {self.columns} x {self.rows} squares of {self.square:g} m cannot be used: give at least 4 x 5 and "
                "at most 14 x 14 squares, and their size in metres"
            )

    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Inner corners of the chessboard, by id: row by row from the top left. Metres, in the board's frame."""
        rows, columns = np.mgrid[1 : self.rows, 1 : self.columns]
        return self.square * np.column_stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)])


@dataclass(frozen=True)
class Detection:
    """The corners of a board that were found in an image."""

    ids: Int[np.ndarray, " k"]
    """Rows of :meth:`Board.corners`."""
    pixels: Float[np.ndarray, "k 2"]
    """Column and row, float64. The centre of a pixel is at its index."""


def detect(image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], board: Board) -> Detection | None:
    """Find a board in an RGB or grey image without lens distortion; None where fewer than ``ENOUGH`` corners are seen.

    Raises:
        RobotError: The image shows the board mirrored.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    found = _corners(grey, board)
    # Markers are not found in a mirror, so a mirrored print looks as if there was none.
    if found is None and _corners(np.ascontiguousarray(grey[:, ::-1]), board):
        raise RobotError("the board is mirrored: print it again without mirroring, or turn off the mirroring of the camera")
    return found


def pdf(board: Board, path: Path) -> None:
    """Write a page of A4 with the board in true size, and a ruler that shows whether the printer kept it.

    Raises:
        RobotError: The board does not fit the page.
    """
    with replacing(path) as partial, matplotlib.rc_context({"pdf.fonttype": 42}):
        page(board).savefig(partial, format="pdf", metadata={"CreationDate": None})


def drawing(board: Board, side: int) -> UInt8[np.ndarray, "h w"]:
    """The board as a grey image whose squares have a side of so many pixels."""
    picture: np.ndarray = _charuco(board).generateImage((side * board.columns, side * board.rows))
    return picture


def page(board: Board) -> Figure:
    """What :func:`pdf` writes. The axes fill the page and count in millimetres from its upper left corner."""
    side = 1000 * board.square
    width, height = side * board.columns, side * board.rows
    left, top = (PAGE[0] - width) / 2, MARGIN + 25
    if left < MARGIN + 18 or top + max(height, RULER) > PAGE[1] - MARGIN - 25:
        raise RobotError(
            f"a board of {width:.0f} x {height:.0f} mm does not fit a page of A4 beside its ruler: at most "
            f"{PAGE[0] - 2 * MARGIN - 36:.0f} x {PAGE[1] - 2 * MARGIN - 50:.0f} mm"
        )
    figure = Figure(figsize=(PAGE[0] / 25.4, PAGE[1] / 25.4))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, PAGE[0]), ylim=(PAGE[1], 0))
    axes.axis("off")
    # One outline for all of it: between separate shapes, some viewers show hairlines.
    outline = Outline.make_compound_path(*(Outline(corner) for corner in _black(board) + [left, top]))
    axes.add_patch(PathPatch(outline, facecolor="black", linewidth=0, snap=False))
    _ruler(axes, left - 6, top)
    title = f"ChArUco, {board.columns} x {board.rows} squares of {side:g} mm, markers {side * MARKER:g} mm, DICT_5X5_100"
    axes.text(PAGE[0] / 2, MARGIN + 6, title, ha="center", va="center", fontsize=11)
    below = (
        f"Print at 100 %, not fitted to the page. Measure: the ruler is {RULER:g} mm, the board {width:g} x {height:g} mm.\n"
        f"If they are not, measure the board's height and give a share of 1/{board.rows} of it with --square, in metres.\n"
        "Glue the page to something flat and stiff, such as glass or aluminium."
    )
    axes.text(PAGE[0] / 2, top + max(height, RULER) + 14, below, ha="center", va="center", fontsize=9, linespacing=1.5)
    return figure


def _corners(grey: np.ndarray, board: Board) -> Detection | None:
    settings = cv2.aruco.CharucoParameters()
    settings.tryRefineMarkers = True
    # Enlarged: at 0.75 m, a bit of a tilted marker is 2 pixels wide, too little to be read.
    large = cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(_charuco(board), settings).detectBoard(large)
    if ids is None or len(ids) < ENOUGH:
        return None
    return Detection(ids.ravel().astype(int), (pixels.reshape(-1, 2).astype(float) + 0.5) / ENLARGED - 0.5)


def _charuco(board: Board) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    return cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, MARKER * board.square, dictionary)


def _black(board: Board) -> Float[np.ndarray, "n 5 2"]:
    """Closed outlines of the black squares, millimetres from the board's upper left corner."""
    charuco = _charuco(board)
    side, bit = 1000 * board.square, 1000 * board.square * MARKER / 7
    places = {(x, y) for x in range(board.columns) for y in range(board.rows)}
    black = []
    for number, corners in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        x, y = (float(value) // board.square for value in np.mean(corners, axis=0)[:2])
        places.remove((int(x), int(y)))
        left, top = side * x + side * (1 - MARKER) / 2, side * y + side * (1 - MARKER) / 2
        bits = cv2.aruco.generateImageMarker(charuco.getDictionary(), int(number), 7) == 0
        black += [_outline(left + bit * col, top + bit * row, bit) for row, col in np.argwhere(bits)]
    black += [_outline(side * x, side * y, side) for x, y in sorted(places)]
    return np.array(black)


def _outline(x: float, y: float, side: float) -> Float[np.ndarray, "5 2"]:
    return np.array([x, y]) + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])


def _ruler(axes: Axes, x: float, top: float) -> None:
    """A vertical ruler whose marks point to the left from ``x``."""
    marks = np.arange(0, RULER + 1)
    axes.vlines(x, top, top + RULER, colors="black", linewidth=0.4)
    axes.hlines(top + marks, x - np.where(marks % 10 == 0, 5, 2), x, colors="black", linewidth=0.3)
    for mark in marks[::10]:
        axes.text(x - 6, top + mark, f"{mark:g}", ha="right", va="center", fontsize=7)
