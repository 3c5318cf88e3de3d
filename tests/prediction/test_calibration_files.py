"""Calibrations and depth images in the formats that people have."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from see2act.errors import UserError
from see2act.prediction.files import Lens, read_depth, read_lens, read_pose

K = np.array([[600.0, 0, 310], [0, 610, 240], [0, 0, 1]])
D = (0.1, -0.2, 0.001, 0.002, 0.05)
ROS = f"""
image_width: 640
image_height: 480
camera_name: d415
distortion_model: plumb_bob
camera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}
distortion_coefficients: {{rows: 1, cols: 5, data: {list(D)}}}
projection_matrix: {{rows: 3, cols: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}}
"""
REALSENSE = {
    "width": 640,
    "height": 480,
    "ppx": 310,
    "ppy": 240,
    "fx": 600,
    "fy": 610,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0, 0, 0, 0, 0],
}
OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()}


def opencv(path: Path) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()


@pytest.mark.parametrize(
    ("name", "content", "distortion", "size"),
    [
        ("three_rows.txt", "600 0 310\n0 610 240\n0 0 1\n", (), None),
        ("commas.txt", "600, 0, 310\n0, 610, 240\n0, 0, 1  # pixels\n", (), None),
        ("one_row.txt", " ".join(map(str, K.ravel())), (), None),
        ("four.csv", "600,610,310,240", (), None),
        ("k.npy", K, (), None),
        ("flat.npy", K.ravel(), (), None),
        ("matrix.json", K.tolist(), (), None),
        ("fx.json", {"fx": 600, "fy": 610, "cx": 310, "cy": 240}, (), None),
        ("realsense.json", REALSENSE, (), (640, 480)),
        ("streams.json", {"color": REALSENSE, "depth": REALSENSE | {"fx": 1}}, (), (640, 480)),
        ("open3d.json", OPEN3D, (), (640, 480)),
        ("camera_info.yaml", ROS, D, (640, 480)),
        ("ros2.yaml", f"width: 640\nheight: 480\nk: {K.ravel().tolist()}\nd: {list(D)}\n", D, (640, 480)),
        ("opencv.yml", opencv, D, None),
        ("named.json", {"camera_matrix": K.tolist(), "dist_coeffs": [list(D)]}, D, None),
    ],
)
def test_intrinsics_are_read(tmp_path: Path, name: str, content: Any, distortion: tuple, size: tuple | None) -> None:
    path = written(tmp_path / name, content)
    lens = read_lens(str(path))
    np.testing.assert_allclose(lens.matrix, K)
    assert lens.distortion == distortion
    assert lens.size == size


def test_intrinsics_are_typed() -> None:
    np.testing.assert_allclose(read_lens("600,610,310,240").matrix, K)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("five.txt", "1 2 3 4 5", "holds 5 numbers, and intrinsics are 9"),
        ("words.json", {"camera": "d415"}, "has camera, in which no calibration is recognised"),
        ("text.json", [["a", "b"]], "something else than numbers"),
        ("broken.json", "{", "cannot be read"),
        ("broken.yaml", "a: [", "cannot be read"),
        ("empty.txt", "", "holds 0 numbers"),
        ("pickled.npy", np.array([{}], object), "cannot be read"),
        ("fisheye.json", REALSENSE | {"model": "kannala_brandt4", "coeffs": [0.1, 0, 0, 0]}, "undistort the images"),
        ("odd.json", {"fx": 600, "fy": 610, "cx": 310, "cy": 240, "coeffs": [0.1]}, "1 distortion coefficients"),
        ("half.json", {"fx": 600, "fy": 610}, "something else than numbers"),
    ],
)
def test_other_intrinsics_are_refused(tmp_path: Path, name: str, content: Any, words: str) -> None:
    with pytest.raises(UserError, match=words) as told:
        read_lens(str(written(tmp_path / name, content)))
    assert "\n" not in str(told.value)


POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", [180, 10, 30], degrees=True).as_matrix()
POSE[:3, 3] = 0.1, -0.2, 0.9
QUATERNION = Rotation.from_matrix(POSE[:3, :3]).as_quat().tolist()
PLACE = POSE[:3, 3].tolist()
ROS_POSE = {"translation": dict(zip("xyz", PLACE, strict=True)), "rotation": dict(zip("xyzw", QUATERNION, strict=True))}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("four_rows.txt", "\n".join(" ".join(map(repr, row)) for row in POSE.tolist())),
        ("three_rows.txt", "\n".join(" ".join(map(repr, row)) for row in POSE[:3].tolist())),
        ("tum.txt", " ".join(map(repr, PLACE + QUATERNION))),
        ("pose.npy", POSE),
        ("pose.json", POSE.tolist()),
        ("named.json", {"camera_to_world": POSE.tolist()}),
        ("transform.yaml", f"header: {{frame_id: base}}\ntransform: {json.dumps(ROS_POSE)}\n"),
        ("lists.json", {"position": PLACE, "orientation": QUATERNION}),
        ("rotation.json", {"t": PLACE, "R": POSE[:3, :3].tolist()}),
    ],
)
def test_poses_are_read(tmp_path: Path, name: str, content: Any) -> None:
    np.testing.assert_allclose(read_pose(written(tmp_path / name, content)), POSE, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"position": PLACE, "orientation": [1, 1, 1, 1]}, "quaternion of length 1"),
        ({"position": [1, 2], "orientation": QUATERNION}, "holds 2 numbers, not 3"),
        ({"position": {"x": 1}, "orientation": QUATERNION}, "something else than numbers"),
        ([1, 2, 3], "holds 3 numbers, and a pose is 16"),
    ],
)
def test_other_poses_are_refused(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(UserError, match=words):
        read_pose(written(tmp_path / "pose.json", content))


def test_depth_in_decimal_numbers_needs_no_scale(tmp_path: Path) -> None:
    import OpenEXR

    depth = np.linspace(0.5, 1, 12, dtype=np.float32).reshape(3, 4)
    np.save(tmp_path / "depth.npy", depth)
    cv2.imwrite(str(tmp_path / "depth.tiff"), depth)
    cv2.imwrite(str(tmp_path / "depth.png"), np.rint(1000 * depth).astype(np.uint16))
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"V": depth}) as file:
        file.write(str(tmp_path / "depth.exr"))
    for name in ("depth.npy", "depth.tiff", "depth.exr"):
        np.testing.assert_array_equal(read_depth(tmp_path / name, None, "--depth"), depth)
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png", 1000, "--depth"), depth, atol=6e-4)
    with pytest.raises(UserError, match="give --depth-scale"):
        read_depth(tmp_path / "depth.png", None, "--depth")


def test_a_lens_is_undistorted() -> None:
    """A straight edge that the lens has bent is straight again, and depth gets no values that were not there."""
    barrel = (-0.3, 0.1, 0.0, 0.0, 0.0)
    rows, cols = np.mgrid[:480, :640].astype(np.float32)
    flat = cv2.undistortPoints(np.stack([cols, rows], -1).reshape(-1, 1, 2), K, np.array(barrel), P=K).reshape(480, 640, 2)
    bent = np.where(flat[..., 0] > 100, 1.0, 2.0).astype(np.float32)  # a vertical edge, as this lens shows it
    edge = [int(np.argmax(row[:300] < 2)) for row in bent[50:430]]
    assert max(edge) - min(edge) > 3
    straight = Lens(K, barrel).undistorted(bent, cv2.INTER_NEAREST)
    assert set(np.unique(straight)) <= {0.0, 1.0, 2.0}
    edge = [int(np.flatnonzero(row[:300] == 2)[-1]) for row in straight[50:430]]
    assert max(edge) - min(edge) <= 1
    assert Lens(K).undistorted(bent, cv2.INTER_NEAREST) is bent


def written(path: Path, content: Any) -> Path:
    if callable(content):
        content(path)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path
