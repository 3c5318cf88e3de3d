"""Images and calibrations of one's own from which nothing can be predicted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import DictConfig
from torch import nn

import see2act
from see2act.commands.predict import main
from see2act.experiment.config import composed
from see2act.experiment.model_file import TrainedModel
from see2act.modules.network import PixelNetwork
from see2act.prediction.files import read_color, read_depth, read_lens, read_pose
from tests.bad_inputs.refusals import command_is_refused, damaged, examples, is_refused, is_refused_or_done, scratch

ROWS, COLS, FOCAL, HIGH = 120, 160, 200.0, 0.5
"""Size of the image and focal length, pixels; metres of the camera above the floor."""
MATRIX = np.array([[FOCAL, 0, COLS / 2], [0, FOCAL, ROWS / 2], [0, 0, 1]])
POSE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, HIGH], [0, 0, 0, 1]])
"""Looks down."""
MODEL = Path(see2act.__file__).parents[1] / "models" / "suction.safetensors"


class Highest(nn.Module):
    """Likes what is high."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, 3:] * 10


@pytest.fixture(scope="module")
def image() -> dict[str, Any]:
    """A block on a floor, from above."""
    depth = np.full((ROWS, COLS), HIGH, np.float32)
    depth[50:70, 70:90] -= 0.04
    color = np.full((ROWS, COLS, 3), 90, np.uint8)
    color[50:70, 70:90] = 200
    network = PixelNetwork(Highest(), nn.Identity(), stride=4, receptive_radius=1)
    config: DictConfig = composed(["primitive=suction", "precision=fp32"])
    return {
        **{"color": color, "depth": depth, "intrinsics": MATRIX, "pose": POSE, "bounds": (-0.1, -0.1, 0.1, 0.1)},
        "checkpoint": TrainedModel(network, config, "none"),
    }


def _predicted(image: dict[str, Any], **changed: Any) -> Callable[[], object]:
    given = {**image, **changed}
    return lambda: see2act.predict(**given)


def test_the_good_image_has_picks(image: dict[str, Any]) -> None:
    assert len(see2act.predict(**image).picks) > 0
    assert len(see2act.predict(**image, background_depth=np.full((ROWS, COLS), HIGH)).picks) > 0


def _holed(depth: np.ndarray, value: float) -> np.ndarray:
    return np.full_like(depth, value)


DEPTHS: dict[str, Callable[[np.ndarray], Any]] = {
    "a row less": lambda depth: depth[:-1],
    "turned": lambda depth: depth.T,
    "with a channel": lambda depth: depth[..., None],
    "of three channels": lambda depth: np.repeat(depth[..., None], 3, axis=2),
    "flat": lambda depth: depth.ravel(),
    "a number": lambda depth: np.float32(0.5),
    "nothing": lambda depth: depth[:0, :0],
    "zero": lambda depth: depth * 0,
    "not a number": lambda depth: depth * np.nan,
    "infinite": lambda depth: depth * np.inf,
    "negative": lambda depth: -depth,
    "huge": lambda depth: depth * 1e6,
    "beyond float32": lambda depth: depth.astype(float) * 1e300,
    "tiny": lambda depth: depth * 1e-6,
    "in millimetres": lambda depth: (depth * 1000).astype(np.uint16),
    "truth values": lambda depth: depth > 0.4,
    "complex": lambda depth: depth.astype(complex) + 1j,
    "objects": lambda depth: depth.astype(object),
    "words": lambda depth: depth.astype(str),
    "a list of words": lambda depth: [["a"] * COLS] * ROWS,
    "None": lambda depth: None,
}
COLORS: dict[str, Callable[[np.ndarray], Any]] = {
    "grey": lambda color: color[..., 0],
    "with alpha": lambda color: np.concatenate([color, color[..., :1]], axis=2),
    "channels first": lambda color: color.transpose(2, 0, 1),
    "floats": lambda color: color / 255.0,
    "16 bits": lambda color: color.astype(np.uint16) * 256,
    "nothing": lambda color: color[:0, :0],
    "a column less": lambda color: color[:, 1:],
    "words": lambda color: color.astype(str),
    "None": lambda color: None,
}


@pytest.mark.parametrize("wrong", DEPTHS)
@given(background=st.booleans(), posed=st.booleans())
@examples(1)
def test_depth_that_is_none_is_refused(wrong: str, background: bool, posed: bool, image: dict[str, Any]) -> None:
    key = "background_depth" if background else "depth"
    changed = {key: DEPTHS[wrong](image["depth"])} | ({} if posed else {"pose": None, "bounds": None})
    if background and wrong == "None":
        return  # which is no background
    is_refused(_predicted(image, **changed))


@pytest.mark.parametrize("wrong", COLORS)
def test_colour_that_is_none_is_refused(wrong: str, image: dict[str, Any]) -> None:
    is_refused(_predicted(image, color=COLORS[wrong](image["color"])))


NOT_FINITE = st.sampled_from([np.nan, np.inf, -np.inf])


@given(
    row=st.integers(0, 2), col=st.integers(0, 2), value=st.one_of(NOT_FINITE, st.floats(1e4, 1e300), st.floats(-1e300, -1e-3))
)
@examples(10)
@example(row=0, col=0, value=0.0)
@example(row=2, col=2, value=0.0)
@example(row=0, col=2, value=COLS + 1.0)
def test_intrinsics_that_are_no_pinhole_are_refused(row: int, col: int, value: float, image: dict[str, Any]) -> None:
    matrix = MATRIX.copy()
    matrix[row, col] = value
    if (row, col) in ((0, 0), (1, 1)) and value > 0 and np.isfinite(value):
        is_refused_or_done(_predicted(image, intrinsics=matrix))  # a very long lens
    else:
        is_refused(_predicted(image, intrinsics=matrix))


@given(
    row=st.integers(0, 3), col=st.integers(0, 3), value=st.one_of(NOT_FINITE, st.floats(1.5, 1e300), st.floats(-1e300, -1.5))
)
@examples(12)
@example(row=3, col=3, value=0.0)
@example(row=2, col=2, value=1.0)
@example(row=0, col=0, value=0.0)
@example(row=2, col=3, value=1e300)
def test_poses_that_move_the_camera_nowhere_are_refused(row: int, col: int, value: float, image: dict[str, Any]) -> None:
    pose = POSE.copy()
    pose[row, col] = value
    if (row, col) in ((0, 3), (1, 3)):  # elsewhere, where nothing lies between the bounds
        value = np.clip(value, -1e300, 1e300)
    is_refused(_predicted(image, pose=pose))


@pytest.mark.parametrize("key", ["intrinsics", "pose"])
@given(
    value=st.one_of(
        st.sampled_from([None, "word", [], [[1, 2], [3]], 5, np.zeros((3, 4)), np.zeros((4, 4)), np.eye(3)[None], np.eye(5)]),
        st.lists(st.floats(), max_size=4),
    )
)
@examples(6)
def test_matrices_of_another_shape_are_refused(key: str, value: Any, image: dict[str, Any]) -> None:
    if key == "pose" and value is None:
        return  # which asks for the dominant plane
    is_refused(_predicted(image, **{key: value}))


@given(bounds=st.tuples(*[st.one_of(NOT_FINITE, st.sampled_from([-1e300, -10.0, -0.1, 0.0, 0.1, 0.1005, 10.0, 1e300]))] * 4))
@examples(12)
@example(bounds=(0.1, -0.1, -0.1, 0.1))
@example(bounds=(0.0, 0.0, 0.0, 0.0))
@example(bounds=(-1e300, -1e300, 1e300, 1e300))
def test_bounds_that_hold_nothing_are_refused(bounds: tuple[float, ...], image: dict[str, Any]) -> None:
    if bounds == (-0.1, -0.1, 0.1, 0.1):
        return
    is_refused_or_done(_predicted(image, bounds=bounds))


@given(
    bounds=st.sampled_from(
        [(), (1,), (0, 0, 1), (0, 0, 1, 1, 1), "abcd", ("a", "b", "c", "d"), (None,) * 4, 5, ((0, 0), (1, 1))]
    )
)
@examples(9)
def test_bounds_that_are_not_four_numbers_are_refused(bounds: Any, image: dict[str, Any]) -> None:
    is_refused_or_done(_predicted(image, bounds=bounds))


@given(
    key=st.sampled_from(["floor", "count", "apart", "per_object"]),
    value=st.one_of(NOT_FINITE, st.sampled_from([-1, 0, -0.5, 1e300, "a"])),
)
@examples(12)
def test_other_numbers_out_of_range_are_refused(key: str, value: Any, image: dict[str, Any]) -> None:
    harmless = {"floor": (0,), "count": (1e300,), "apart": (1e300,), "per_object": (1e300,)}
    check = is_refused_or_done if value in harmless[key] else is_refused
    check(_predicted(image, **{key: value}))


# Files


@pytest.fixture(scope="module")
def files(image: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Good ones, as people have them."""
    folder = tmp_path_factory.mktemp("good")
    millimetres = np.rint(image["depth"] * 1000).astype(np.uint16)
    cv2.imwrite(str(folder / "color.png"), image["color"])
    cv2.imwrite(str(folder / "color.jpg"), image["color"])
    cv2.imwrite(str(folder / "depth.png"), millimetres)
    cv2.imwrite(str(folder / "depth.tiff"), image["depth"])
    np.save(folder / "depth.npy", image["depth"])
    _write_exr(folder / "depth.exr", image["depth"])
    np.savetxt(folder / "intrinsics.txt", MATRIX)
    np.save(folder / "intrinsics.npy", MATRIX)
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": COLS / 2, "cy": ROWS / 2, "width": COLS, "height": ROWS}
    (folder / "intrinsics.json").write_text(json.dumps(lens))
    camera = {
        **{"image_width": COLS, "image_height": ROWS, "distortion_model": "plumb_bob"},
        "camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX.ravel().tolist()},
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0.0, 0.0, 0.0, 0.0]},
    }
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(camera))
    np.savetxt(folder / "pose.txt", POSE)
    np.save(folder / "pose.npy", POSE)
    turn = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}
    (folder / "pose.json").write_text(json.dumps({"translation": {"x": 0.0, "y": 0.0, "z": HIGH}, "rotation": turn}))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _write_exr(path: Path, depth: np.ndarray) -> None:
    import OpenEXR

    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Z": depth}).write(str(path))


READERS: dict[str, Callable[[Path], object]] = {
    "color": read_color,
    "depth": lambda path: read_depth(path, 1000.0, "--depth"),
    "intrinsics": lambda path: read_lens(str(path)),
    "pose": read_pose,
}
NAMES = (
    *("color.png", "color.jpg", "depth.png", "depth.tiff", "depth.npy", "depth.exr"),
    *("intrinsics.txt", "intrinsics.npy", "intrinsics.json", "intrinsics.yaml", "pose.txt", "pose.npy", "pose.json"),
)


def _reader(name: str) -> Callable[[Path], object]:
    return READERS[name.split(".")[0]]


def test_the_good_files_are_read(files: dict[str, bytes], tmp_path: Path) -> None:
    assert set(files) == set(NAMES)
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        _reader(name)(tmp_path / name)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@examples(4)
def test_damage_of_a_file_is_refused_or_does_no_harm(name: str, data: st.DataObject, files: dict[str, bytes]) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(data.draw(damaged(files[name])))
        is_refused_or_done(lambda: _reader(name)(folder / name), folder)


@pytest.mark.parametrize("name", NAMES)
@given(share=st.floats(0, 0.5))
@examples(1)
def test_a_file_that_was_cut_short_is_refused(name: str, share: float, files: dict[str, bytes]) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(files[name][: int(share * len(files[name]))])
        check = is_refused_or_done if name.endswith(".yaml") else is_refused  # whose first half may be whole by itself
        check(lambda: _reader(name)(folder / name), folder)


@pytest.mark.parametrize("name", NAMES)
@given(content=st.binary(max_size=100))
@examples(1)
@example(content=b"")
@example(content=b"\xff\xfe1 2 3")
@example(content=b"1e999 nan inf -1e999")
@example(content=b"[" * 2000)
@example(content=b"a: &a [*a]")
@example(content=b"&a [" + b"*a," * 9 + b"]")
@example(content=b'{"fx": 1, "fy": "b"}')
@example(content=b'{"k": {"data": [1, 2, 3, 4, 5, 6, 7, 8, "x"]}}')
@example(content=b'{"translation": {"x": 1}, "rotation": [0, 0, 0, 0]}')
@example(content=b'{"a": {"b": {"c": {}}}}')
@example(content=b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9999999999), }\n")
def test_whatever_bytes_are_none_of_these(name: str, content: bytes) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(content)
        is_refused(lambda: _reader(name)(folder / name), folder)


KEYS = ("fx", "fy", "cx", "k", "d", "data", "matrix", "rotation", "translation", "pose", "color", "width")
JSONS = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-3, 3), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(
            st.sampled_from(
                ["fx", "fy", "cx", "k", "d", "data", "matrix", "rotation", "translation", "pose", "color", "width"]
            ),
            inner,
            max_size=3,
        ),
    ),
    max_leaves=8,
)


@given(content=JSONS, kind=st.sampled_from(["intrinsics", "pose"]), ending=st.sampled_from([".json", ".yaml"]))
@examples(30)
@example(content={"k": {"fx": 1}}, kind="intrinsics", ending=".json")
@example(content={"k": []}, kind="intrinsics", ending=".json")
@example(content={"fx": [1, 2], "fy": {}}, kind="intrinsics", ending=".json")
@example(content={"rotation": 3, "translation": None}, kind="pose", ending=".json")
@example(content={"matrix": {"data": {"data": 3}}}, kind="pose", ending=".json")
def test_a_calibration_of_something_else_is_refused(content: Any, kind: str, ending: str) -> None:
    with scratch() as folder:
        path = folder / f"file{ending}"
        path.write_text(json.dumps(content) if ending == ".json" else yaml.safe_dump(content))
        is_refused_or_done(lambda: READERS[kind](path), folder)


# The command


def _arguments(folder: Path, files: dict[str, bytes], **changed: str) -> list[str]:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    options = {
        **{"checkpoint": str(MODEL), "color": f"{folder}/color.png", "depth": f"{folder}/depth.png", "depth-scale": "1000"},
        **{"intrinsics": f"{folder}/intrinsics.txt", "out": f"{folder}/out"},
    }
    words = [f"--{key}={value}" for key, value in {**options, **changed}.items() if value != "left out"]
    return words


OPTIONS = (
    *({"depth-scale": value} for value in ("0", "-1", "nan", "inf", "a", "", "1e-300", "1e300")),
    *({"count": value} for value in ("0", "-3", "1.5", "a", "nan")),
    *({"apart": value} for value in ("0", "-1", "nan", "inf", "a")),
    *({"per-object": value} for value in ("0", "-1", "a")),
    *({"floor": value} for value in ("nan", "inf", "a", "9")),
    *({"intrinsics": value} for value in ("1,2,3", "1,2,3,a", "nan,1,1,1", "0,0,0,0", "", ".", "1,2,3,4,5")),
    *({"primitive": value} for value in ("push", "", "grasp")),
    *({"checkpoint": value} for value in ("", ".", "/dev/null", "left out")),
    *(
        {key: value}
        for key in ("color", "depth", "pose", "background-depth")
        for value in ("", ".", "nowhere.png", "/dev/null")
    ),
    *({"out": value} for value in ("{}/color.png", "{}/color.png/below", "/dev/null/out", "left out")),
    *({"nonsense": "1"}, {"bounds": "1"}),
)


@pytest.mark.parametrize("changed", OPTIONS, ids=str)
def test_options_that_make_no_sense_are_refused(changed: dict[str, str], files: dict[str, bytes], tmp_path: Path) -> None:
    changed = {key: value.replace("{}", str(tmp_path)) for key, value in changed.items()}
    command_is_refused(main, _arguments(tmp_path, files, **changed), tmp_path)
