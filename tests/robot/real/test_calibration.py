from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.calibration import INTRINSICS, SIZE, Case, Errors, case, measure, summary
from benchmarks.stand_in.board import with_board
from see2act.robot.real.board import Board, Detection, detect, pdf
from see2act.robot.real.calibration import Calibration, calibrate
from see2act.robot.real.views import View, bin_points, propose, seen
from see2act.robot.types import RobotError

A4 = np.array([210.0, 297.0])
MM = 72 / 25.4
"""Points of a millimetre."""


# The board


def test_the_page_has_true_size(tmp_path: Path) -> None:
    shapes = _shapes(tmp_path, Board())
    squares = np.concatenate([shape for shape in shapes if len(shape) == 5])
    lines = np.concatenate([shape for shape in shapes if len(shape) == 2])
    assert np.ptp(squares, axis=0) == pytest.approx([120, 160], abs=1e-4)
    assert np.ptp(lines, axis=0)[1] == pytest.approx(100, abs=1e-4)
    sizes = {round(float(np.ptp(shape[:, 0])), 4) for shape in shapes if len(shape) == 5}
    assert sizes == {20.0, round(15 / 7, 4)}
    everything = np.concatenate(shapes)
    assert everything.min() >= 12
    assert (everything <= A4 - 12).all()


def test_the_squares_keep_their_size_when_another_is_asked_for(tmp_path: Path) -> None:
    squares = np.concatenate([shape for shape in _shapes(tmp_path, Board(square=0.0196)) if len(shape) == 5])
    assert np.ptp(squares, axis=0) == pytest.approx([6 * 19.6, 8 * 19.6], abs=1e-4)


def test_the_board_of_the_page_is_found(tmp_path: Path) -> None:
    """Drawn from the outlines in the file, 8 pixels a millimetre."""
    image = np.full((297 * 8, 210 * 8), 255, np.uint8)
    for shape in _shapes(tmp_path, Board()):
        if len(shape) == 5:
            cv2.fillPoly(image, [np.round((shape * 8 - 0.5) * 256).astype(np.int32)], 0, shift=8)
    found = detect(image, Board())
    assert found is not None
    assert found.ids.tolist() == list(range(35))
    millimetres = (found.pixels + 0.5) / 8
    assert np.abs(millimetres - millimetres[0] - 1000 * (Board().corners() - Board().corners()[0])[:, :2]).max() < 0.1


def test_a_board_that_does_not_fit_the_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="198 x 264 mm does not fit a page of A4"):
        pdf(Board(square=0.033), tmp_path / "board.pdf")


@pytest.mark.parametrize("size", [(3, 6, 0.02), (15, 15, 0.02), (6, 8, 20.0), (6, 8, 0.0)])
def test_an_impossible_board_is_refused(size: tuple[int, int, float]) -> None:
    with pytest.raises(RobotError, match="cannot be used"):
        Board(*size)


@pytest.mark.parametrize("tilt", [0, 25, 45])
def test_corners_are_where_they_are_seen(tilt: float) -> None:
    """The centre of a pixel is at its index: no shift on average."""
    rng, off = np.random.default_rng(tilt), []
    for turn in rng.uniform(-180, 180, 4):
        pose = _board_pose(tilt, turn, rng)
        found = detect(_image(Board(), pose, rng)[0], Board())
        assert found is not None
        assert len(found.ids) >= 30
        off.append(found.pixels - _project(Board().corners()[found.ids], pose))
    errors = np.concatenate(off)
    assert np.abs(errors.mean(0)).max() < 0.04
    assert errors.std() < 0.2


def test_a_detection_holds_ids_and_pixels() -> None:
    found = detect(_image(Board(), _board_pose(0, 0, np.random.default_rng(0)), np.random.default_rng(0))[0], Board())
    assert isinstance(found, Detection)
    assert found.pixels.shape == (len(found.ids), 2)
    assert found.pixels.dtype == np.float64


def test_a_mirrored_board_is_refused() -> None:
    rng = np.random.default_rng(0)
    image = _image(Board(), _board_pose(20, 30, rng), rng)[0]
    with pytest.raises(RobotError, match="the board is mirrored: print it again"):
        detect(np.ascontiguousarray(image[:, ::-1]), Board())


def test_too_little_of_a_board_is_no_view() -> None:
    rng = np.random.default_rng(0)
    pose = _board_pose(0, 0, rng)
    image = _image(Board(), pose, rng)[0]
    assert detect(np.full_like(image, 90), Board()) is None
    left = int(_project(Board().corners()[[0]], pose)[0, 0])
    image[:, left + 30 :] = 90
    assert detect(image, Board()) is None


# The calibration


@pytest.mark.parametrize("seed", range(3))
def test_a_calibration_is_within_a_millimetre_and_says_how_far_off_it_is(seed: int) -> None:
    station = case(seed)
    result = _calibrated(station)
    error = _error(station, result)
    assert error < 0.001
    assert 0.5 < error / result.error < 2
    assert result.verdict == "good"
    assert (result.views, result.dropped) == (25, {})
    assert result.square == pytest.approx(0.02, rel=0.003)


def test_a_camera_that_is_exact_is_found_exactly() -> None:
    exact = Errors(pixel=0, disparity=0, position=0, rotation=0, focal=0, centre=0, offset=0.003)
    station = case(0, exact)
    result = _calibrated(station)
    assert _error(station, result) < 1e-5
    assert np.allclose(result.camera, station.camera, atol=1e-5)
    assert result.depth_scale == pytest.approx(1 / 1.005, rel=1e-3)
    assert result.depth_offset == pytest.approx(-0.003 / 1.005, abs=3e-4)
    flange = station.views[3].flange
    assert np.allclose(np.linalg.inv(station.camera) @ flange @ result.board, station.boards[3], atol=1e-5)


def test_images_and_depth_give_a_calibration_within_a_millimetre() -> None:
    station, rng = case(5), np.random.default_rng(5)
    views = []
    for view, pose in zip(station.views, station.boards, strict=True):
        image, depth = _image(station.board, pose, rng)
        disparity = INTRINSICS[0, 0] * 0.055 / station.errors.depth(depth[depth > 0])
        disparity += 0.08 * rng.normal(size=disparity.shape)
        depth[depth > 0] = INTRINSICS[0, 0] * 0.055 / disparity
        views.append(seen(view.flange, image, depth, station.board))
    found = [view for view in views if view is not None]
    assert len(found) >= 23
    result = _calibrated(replace(station, views=found))
    assert _error(station, result) < 0.001
    assert 0.5 < _error(station, result) / result.error < 2


def test_a_corner_without_depth_around_it_has_none() -> None:
    rng = np.random.default_rng(0)
    image, depth = _image(Board(), _board_pose(10, 0, rng), rng)
    whole = seen(np.eye(4), image, depth, Board())
    assert whole is not None
    assert np.abs(whole.depth - 0.75).max() < 0.1
    hole, crack = np.round(whole.pixels[[7, 20]]).astype(int)
    depth[hole[1] - 3 : hole[1] + 4, hole[0] - 3 : hole[0] + 4] = 0
    depth[crack[1]] = 0
    view = seen(np.eye(4), image, depth, Board())
    assert view is not None
    assert np.flatnonzero(view.depth == 0).tolist() == [7]
    assert view.depth[20] == pytest.approx(whole.depth[20], abs=1e-3)


@pytest.mark.parametrize("square", [0.98, 1.02, 1.25])
def test_squares_of_another_size_are_refused_with_their_size(square: float) -> None:
    with pytest.raises(RobotError, match="measure the board and give --square") as caught:
        _calibrated(case(0, Errors(square=square)))
    said = re.search(r"the squares seem to be ([\d.]+) mm, not 20\.0", str(caught.value))
    assert said is not None
    assert float(said[1]) == pytest.approx(20 * square, rel=0.01)


def test_squares_that_are_a_little_off_do_no_harm() -> None:
    station = case(0, Errors(square=1.007))
    result = _calibrated(station)
    assert result.square == pytest.approx(0.02014, rel=0.003)
    assert _error(station, result) < 0.001


def test_views_that_do_not_fit_are_dropped_and_named() -> None:
    station = case(1)
    clean = _error(station, _calibrated(station))
    station.views[4] = replace(station.views[4], flange=_shifted(station.views[4].flange, 0.01))
    station.views[9] = replace(station.views[9], flange=_shifted(station.views[9].flange, 0.0, turn=0.5))
    bent = station.views[17].pixels + np.random.default_rng(0).normal(size=(35, 2)) * 3
    station.views[17] = replace(station.views[17], pixels=bent)
    station.views[20] = View(station.views[20].flange, *(getattr(station.views[20], k)[:8] for k in ("ids", "pixels", "depth")))
    result = _calibrated(station)
    assert set(result.dropped) == {4, 9, 17, 20}
    assert result.views == 21
    assert "pixels off the others" in result.dropped[4]
    assert "off a flat board" in result.dropped[17]
    assert "only 8 corners" in result.dropped[20]
    assert _error(station, result) < clean + 0.0003


def test_missing_and_wild_depth_do_little_harm() -> None:
    station, rng = case(2), np.random.default_rng(0)
    for index, view in enumerate(station.views):
        wild = view.depth + rng.uniform(0.02, 0.3, 35) * (rng.random(35) < 0.2)
        station.views[index] = replace(view, depth=np.where(rng.random(35) < 0.5, 0, wild))
    assert _error(station, _calibrated(station)) < 0.001


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda view, rng: replace(view, depth=view.depth * (rng.random(35) < 0.1)), "depth at only [0-9]+%"),
        (lambda view, rng: replace(view, depth=view.depth * 1000), "multiplied by 0.001: it is not in metres"),
        (lambda view, rng: replace(view, flange=_shifted(view.flange, *rng.normal(size=1) * 0.004)), "loose or bent"),
        (lambda view, rng: replace(view, pixels=view.pixels + rng.normal(size=(35, 2)) * 3), "only 0 of 25 views.*view 1: its"),
    ],
)
def test_measurements_that_cannot_be_are_refused(change: Callable[..., View], message: str) -> None:
    station, rng = case(0), np.random.default_rng(1)
    with pytest.raises(RobotError, match=message):
        _calibrated(replace(station, views=[change(view, rng) for view in station.views]))


def test_too_few_views_are_refused() -> None:
    station = case(0)
    with pytest.raises(RobotError, match="no image shows the board"):
        _calibrated(replace(station, views=[]))
    with pytest.raises(RobotError, match="only 11 of 11 views can be used, and 12 are needed"):
        _calibrated(replace(station, views=station.views[:11]))


def test_motion_that_tells_too_little_is_refused() -> None:
    with pytest.raises(RobotError, match="only 2 about any other: tilt the board"):
        _calibrated(case(0, tilt=np.radians(5)))
    with pytest.raises(RobotError, match=r"the board moved by .* move it by 100 mm"):
        _calibrated(case(0, radius=0.01))
    with pytest.raises(RobotError, match=r"points in the bin would be .* mm off, more than 3"):
        _calibrated(case(0, Errors(position=12e-4, rotation=20e-4), count=12, tilt=np.radians(20), radius=0.05))


def test_turns_about_one_axis_are_refused() -> None:
    """Those of the flange itself: the board stays in view."""
    station = case(0)
    views, start = [], station.views[0].flange
    for view, angle in zip(station.views, np.linspace(-40, 40, 25), strict=True):
        flange = start.copy()
        flange[:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix() @ start[:3, :3]
        views.append(replace(view, flange=flange))
    with pytest.raises(RobotError, match="about one axis and only 0 about any other"):
        _calibrated(replace(station, views=views))


def test_the_verdict_follows_the_error() -> None:
    result = _calibrated(case(0))
    assert replace(result, error=0.0009).verdict == "good"
    assert replace(result, error=0.002).verdict.startswith("usable, but")


# The poses, and the points


def test_proposed_poses_turn_the_board_about_its_middle() -> None:
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("xyz", [2.9, 0.2, 0.5]).as_matrix()
    start[:3, 3] = [0.4, 0.1, 0.5]
    centre = np.array([0.01, -0.13, 0.02])
    poses = propose(start, centre, count=40, radius=0.1, tilt=0.6, seed=3)
    middle = (start @ [*centre, 1])[:3]
    moved = np.array([(pose @ [*centre, 1])[:3] - middle for pose in poses])
    assert np.abs(moved).max() <= 0.1
    assert np.ptp(moved, axis=0).min() > 0.15
    turns = np.array([Rotation.from_matrix(pose[:3, :3] @ start[:3, :3].T).as_rotvec() for pose in poses])
    angles = np.linalg.norm(turns, axis=1)
    assert 0.3 <= angles.min() <= angles.max() <= 0.6
    assert (np.abs(turns.mean(0)) < 0.1).all()
    assert turns.std(0) == pytest.approx(0.27, abs=0.05)
    assert all(np.array_equal(a, b) for a, b in zip(poses, propose(start, centre, 40, 0.1, 0.6, 3), strict=True))
    assert not np.allclose(poses[0], propose(start, centre, 40, 0.1, 0.6, 4)[0])


def test_points_are_on_the_bins_floor_and_above() -> None:
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    world[:3, 3] = [0.5, 0, -0.1]
    points = bin_points(world, (0.4, 0.2), 0.05)
    assert points.min(0) == pytest.approx([0.4, -0.2, -0.1])
    assert points.max(0) == pytest.approx([0.6, 0.2, -0.05])


def test_the_table_has_a_row_for_a_way_and_for_a_station() -> None:
    rows = [summary(row, [measure(row, seed) for seed in range(2)]) for row in ("closed form", "15 views")]
    assert 2 < rows[0]["error"] < 8
    assert rows[1]["error"] < 1
    assert 0 <= rows[1]["within twice"] <= 1


def _calibrated(station: Case) -> Calibration:
    return calibrate(station.views, station.intrinsics, station.board, station.points)


def _error(station: Case, result: Calibration) -> float:
    return station.error(result.camera, result.depth_scale, result.depth_offset)


def _shifted(pose: np.ndarray, by: float, turn: float = 0.0) -> np.ndarray:
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec([turn, 0, 0]).as_matrix()
    change[1, 3] = by
    return pose @ change


def _shapes(folder: Path, board: Board) -> list[np.ndarray]:
    """Outlines and lines of the page, millimetres from its upper left corner."""
    pdf(board, folder / "board.pdf")
    raw = (folder / "board.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", raw)
    assert box is not None
    assert np.array([float(side) for side in box.groups()]) / MM == pytest.approx(A4, abs=1e-6)
    pages = [zlib.decompress(part) for part in re.findall(rb"stream\r?\n(.*?)endstream", raw, re.S) if part[:1] == b"x"]
    page = next(text.decode("latin1") for text in pages if b" m\n" in text and b"BT" in text)
    page = page[: page.rindex(" l\n") + 3]  # texts, which have scales of their own, come last
    assert " cm" not in page, "something scales the page"
    shapes = re.findall(r"[\d.]+ [\d.]+ m\n(?:[\d.]+ [\d.]+ l\n)+", page)
    points = [np.array(re.findall(r"([\d.]+) ([\d.]+) [ml]", shape), float) / MM for shape in shapes]
    # The first is the white of the page.
    return [shape * [1, -1] + [0, A4[1]] for shape in points[1:]]


def _board_pose(tilt: float, turn: float, rng: np.random.Generator) -> np.ndarray:
    """Board to camera, 0.75 m away, tilted about an axis of its plane, degrees."""
    axis = rng.uniform(0, 2 * np.pi)
    tilted = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(axis), np.sin(axis), 0]))
    pose = np.eye(4)
    pose[:3, :3] = (tilted * Rotation.from_euler("z", turn, degrees=True)).as_matrix()
    pose[:3, 3] = [*rng.uniform(-0.05, 0.05, 2), 0.75] - pose[:3, :3] @ Board().corners().mean(0)
    return pose


def _project(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    return ((camera / camera[:, 2:]) @ INTRINSICS.T)[:, :2]


def _image(board: Board, pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A board in the camera: RGB with blur and noise, and its depth in metres without noise; 0 around it."""
    grey, nothing = np.full((*SIZE[::-1], 3), 94, np.uint8), np.zeros(SIZE[::-1], np.float32)
    color, depth = with_board(grey, nothing, board, pose, INTRINSICS)
    return np.clip(color + rng.normal(size=(*SIZE[::-1], 1)) * 4, 0, 255).astype(np.uint8), depth
