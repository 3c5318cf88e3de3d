"""Picks in images: of the simulator's camera, so that what is right is known."""

from __future__ import annotations

import argparse
import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import load_file, save_file
from scipy.spatial.transform import Rotation
from torch import nn

import see2act
from see2act.commands.predict import _read, main
from see2act.experiment import model_file as model_files
from see2act.experiment.model_file import ModelFileError, TrainedModel
from see2act.modules.network import PixelNetwork
from see2act.prediction.depth import with_small_holes_filled, without_flying_pixels
from see2act.prediction.errors import ImageError
from see2act.prediction.floor import floor_pose, level_floor
from see2act.prediction.jaws import blocked
from see2act.prediction.picture import _direction_in_image
from see2act.prediction.posed_image import HALF, _workspace
from see2act.prediction.predict import _blocked
from see2act.robot.heightmap import point_cloud, project
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Observation
from tests.modules.make import make_module

BOUNDS = (-0.18, -0.18, 0.18, 0.18)


class Highest(nn.Module):
    """Likes what is high."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, 3:] * 10


@pytest.fixture(scope="module")
def highest(config: Callable[..., DictConfig]) -> TrainedModel:
    return TrainedModel(
        PixelNetwork(Highest(), nn.Identity(), stride=4, receptive_radius=1), config("primitive=suction"), "none"
    )


@pytest.fixture(scope="module")
def robot(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    """Its camera takes its whole image, with the table around the bin, as people's cameras do."""
    robot = make_robot("primitive=suction", "robot.video=true")
    robot.camera = replace(robot.camera, crop=None)

    def look() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with robot.simulation.hidden(robot.arm.body):
            return robot.camera.render(robot.simulation)

    robot._look = look
    return robot


@pytest.fixture(scope="module")
def seen(robot: SimulatedRobot) -> Observation:
    robot.reset(3, "seen")
    return robot.observe()


@pytest.fixture
def image(robot: SimulatedRobot, seen: Observation) -> dict[str, Any]:
    return {"color": seen.color, "depth": seen.depth, "intrinsics": robot.camera.intrinsics - HALF}


def test_with_a_pose_the_heightmap_is_the_robot_s_own(
    image: dict, highest: TrainedModel, robot: SimulatedRobot, seen: Observation
) -> None:
    found = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS)
    depth = with_small_holes_filled(without_flying_pixels(image["depth"], image["intrinsics"]), image["intrinsics"])
    points = point_cloud(depth, robot.camera.intrinsics, robot.camera.pose)
    mended = project(image["color"], depth, points, robot.workspace)
    np.testing.assert_allclose(found.heightmap.height, mended.height, atol=1e-3)  # the floor is found by itself
    assert np.mean(np.abs(mended.height - seen.heightmap.height) > 1e-3) < 0.02  # at edges alone
    same = (found.heightmap.color == mended.color).all(axis=-1)
    assert same.mean() > 0.998  # of two points in one cell another one may be the highest


def test_a_pick_says_the_same_place_in_every_frame(image: dict, highest: TrainedModel, robot: SimulatedRobot) -> None:
    pose = robot.camera.pose
    found = see2act.predict(**image, checkpoint=highest, pose=pose, bounds=BOUNDS, count=6, apart=0.03)
    assert len(found.picks) == 6
    assert [pick.score for pick in found.picks] == sorted((pick.score for pick in found.picks), reverse=True)
    best = found.picks[0]
    assert best.position[2] == pytest.approx(found.heightmap.height[found.source >= 0].max(), abs=1e-3)
    for pick in found.picks:
        np.testing.assert_allclose(pose[:3, :3] @ pick.position_camera + pose[:3, 3], pick.position, atol=1e-5)
        assert image["depth"][pick.v, pick.u] == pytest.approx(pick.position_camera[2], abs=1e-6)
        x, y = found.workspace.to_world(pick.row, pick.col)
        np.testing.assert_allclose((x, y), pick.position[:2], atol=0.0013)
        above = pick.position[2] - found.floor.at(*pick.position[:2])
        assert found.heightmap.height[pick.row, pick.col] == pytest.approx(above, abs=1e-5)
        assert pick.angle is None
    at = np.array([pick.position[:2] for pick in found.picks])
    distances = np.linalg.norm(at[:, None] - at[None], axis=2) + np.eye(6)
    assert distances.min() > 0.03 - 0.0025 * 2


def test_without_a_pose_the_floor_is_found(image: dict, highest: TrainedModel, robot: SimulatedRobot) -> None:
    truth = robot.camera.pose
    found = floor_pose(image["depth"], robot.camera.intrinsics)
    assert found[2, 3] == pytest.approx(truth[2, 3] + 0.01, abs=0.003)  # the table, of which more is seen than of the bin
    assert found[2, :3] @ truth[2, :3] > np.cos(np.radians(0.5))
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    assert found[0, 0] > 0  # x to the image's right
    theirs = see2act.predict(**image, checkpoint=highest, pose=truth, bounds=BOUNDS)
    middle = found @ np.linalg.inv(truth) @ [0, 0, 0, 1]  # of the bin, in the world that was found
    bounds = tuple(middle[[0, 1, 0, 1]] + BOUNDS)
    ours = see2act.predict(**image, checkpoint=highest, bounds=bounds)
    assert ours.floor.at(*ours.middle) == pytest.approx(0.01, abs=0.003)  # the bin's own floor
    np.testing.assert_allclose(
        ours.heightmap.height[ours.source >= 0].max(), theirs.heightmap.height[theirs.source >= 0].max(), atol=0.005
    )
    assert ours.picks[0].position[2] == pytest.approx(theirs.picks[0].position[2] + 0.01, abs=0.005)


def test_a_floor_that_is_not_at_zero_is_asked_for(image: dict, highest: TrainedModel, robot: SimulatedRobot) -> None:
    """As in the frame of a robot that stands on something."""
    raised = robot.camera.pose.copy()
    raised[2, 3] += 0.1
    with pytest.raises(ImageError, match=r"seen at z = 0\.10\d m.*give floor 0\.10"):
        see2act.predict(**image, checkpoint=highest, pose=raised, bounds=BOUNDS)
    ours = see2act.predict(**image, checkpoint=highest, pose=raised, bounds=BOUNDS, floor=0.1)
    theirs = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS)
    np.testing.assert_allclose(ours.heightmap.height, theirs.heightmap.height, atol=1e-4)
    np.testing.assert_allclose(ours.picks[0].position, np.add(theirs.picks[0].position, (0, 0, 0.1)), atol=1e-4)
    with pytest.raises(ImageError, match=r"seen at z = 0\.10\d m, and not within 6 cm of 0\.3"):
        see2act.predict(**image, checkpoint=highest, pose=raised, bounds=BOUNDS, floor=0.3)
    with pytest.raises(ImageError, match="the floor nan is no number"):
        see2act.predict(**image, checkpoint=highest, pose=raised, bounds=BOUNDS, floor=float("nan"))


@pytest.mark.parametrize(("shift", "tilt"), [(0.04, 0.0), (-0.04, 0.0), (0.02, 3.0)])
def test_a_floor_that_is_off_is_corrected_and_said(
    image: dict, highest: TrainedModel, robot: SimulatedRobot, shift: float, tilt: float
) -> None:
    """A pose with an error: the heights are those of the right one, and the places are in the frame of the wrong one."""
    wrong = robot.camera.pose.copy()
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    wrong[:3] = turn @ wrong[:3]
    wrong[2, 3] += shift
    ours = see2act.predict(**image, checkpoint=highest, pose=wrong, bounds=BOUNDS, count=1)
    theirs = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS, count=1)
    best = theirs.picks[0]
    np.testing.assert_allclose(ours.picks[0].position_camera, best.position_camera, atol=0.004)
    x, y, z = ours.picks[0].position
    assert z - ours.floor.at(x, y) == pytest.approx(best.position[2], abs=0.003)
    assert ours.floor.at(0, 0) == pytest.approx(shift, abs=0.002)
    assert np.degrees(ours.floor.tilt) == pytest.approx(tilt, abs=0.3)
    (note,) = ours.notes
    assert note.startswith(f"warning: the floor is seen {1000 * shift:+.0f} mm"[:-4])
    assert not theirs.notes[0].startswith("warning")


def test_the_floor_is_the_lowest_plane_and_not_the_largest() -> None:
    """A book covers most of a bin, and lies just where the floor is said to be."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-0.2, 0.2, (3000, 2)), rng.normal(-0.03, 0.001, 3000)])
    book = np.column_stack([rng.uniform(-0.1, 0.1, (7000, 2)), rng.normal(0.0, 0.001, 7000)])
    found = level_floor(np.concatenate([floor, book]), near=0.0, within=0.06)
    assert found is not None
    assert found.level == pytest.approx(-0.03, abs=1e-3)
    assert level_floor(book + [0, 0, 0.1], near=0.0, within=0.06) is None


def test_fingers_must_find_room_beside_an_object() -> None:
    height = np.zeros((100, 100), np.float32)
    height[30:70, 45:55] = 0.05  # a bar, 10 wide and 40 long
    fingertip = np.maximum(height - 0.03, 0.002)
    hit = blocked(height, fingertip, angles=2, inner=0.0425, outer=(0.065, 0.0125), pixel=0.0025)
    assert hit.shape == (2, 100, 100)
    assert not hit[0, 50, 50]  # across the bar
    assert hit[1, 50, 50]  # along it: the fingers come down on it
    height[48:52, 70:74] = 0.04  # a neighbour where the right finger goes
    assert blocked(height, fingertip, 2, 0.0425, (0.065, 0.0125), 0.0025)[0, 50, 50]
    height[48:52, 70:74] = 0.0
    height[50, 70] = 0.04  # one wrong reading is no neighbour
    assert not blocked(height, fingertip, 2, 0.0425, (0.065, 0.0125), 0.0025)[0, 50, 50]


def test_a_grasp_has_room_between_the_bounds(image: dict, robot: SimulatedRobot, config: Callable[..., DictConfig]) -> None:
    cfg = config("primitive=grasp")
    model = TrainedModel(PixelNetwork(Highest(), nn.Identity(), stride=4, receptive_radius=1), cfg, "none")
    found = see2act.predict(**image, checkpoint=model, pose=robot.camera.pose, bounds=BOUNDS, count=40, apart=0.005)
    along, across = cfg.primitive.footprint
    for pick in found.picks:
        ends = [(s * along, t * across) for s in (-1, 1) for t in (-1, 1)]
        cosine, sine = np.cos(pick.angle), np.sin(pick.angle)
        corners = np.array(
            [(pick.position[0] + a * cosine - b * sine, pick.position[1] + a * sine + b * cosine) for a, b in ends]
        )
        assert np.abs(corners).max() < 0.18 + 0.0025


class Bars(nn.Module):
    """Likes what is high and narrow along the row."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        height, average = x[:, 3:], nn.functional.avg_pool2d
        return 20 * (average(height, 9, stride=1, padding=4) - average(height, (1, 41), stride=1, padding=(0, 20)))


@pytest.mark.parametrize("degrees", [0, 33.75, 67.5, 90, 135])
def test_jaws_close_across_a_bar(degrees: float, config: Callable[..., DictConfig]) -> None:
    """A bar 3 cm wide, which has no ends, lying on a floor under a camera that looks straight down."""
    pixels = np.indices((400, 400)) - 199.5
    x, y = pixels[1] * 1e-3, -pixels[0] * 1e-3  # 1 mm a pixel at the floor
    radians = np.radians(degrees)
    across = y * np.cos(radians) - x * np.sin(radians)
    bar = np.abs(across) < 0.015
    depth = np.where(bar, 0.96, 1.0).astype(np.float32)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 1.0
    model = TrainedModel(PixelNetwork(Bars(), nn.Identity(), stride=4, receptive_radius=20), config("primitive=grasp"), "none")
    intrinsics = np.array([[1000.0, 0, 199.5], [0, 1000, 199.5], [0, 0, 1]])
    color = np.zeros((400, 400, 3), np.uint8)
    found = see2act.predict(color, depth, intrinsics, model, pose=pose, bounds=BOUNDS, count=1)
    angle = np.degrees(found.picks[0].angle)
    assert abs((angle - degrees - 90 + 90) % 180 - 90) <= 12
    direction = _direction_in_image(found.picks[0], found)
    assert direction is not None
    assert np.degrees(np.arctan2(-direction[1], direction[0])) % 180 == pytest.approx(angle, abs=0.5)
    assert np.hypot(*direction) == pytest.approx(0.065 * 1000 / 0.96, rel=0.05)  # to the outer end of the open jaw


def test_bounds_away_from_the_middle_move_the_heightmap_and_not_the_world(
    image: dict, highest: TrainedModel, robot: SimulatedRobot
) -> None:
    whole = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS)
    x, y, _ = whole.picks[0].position
    near = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=(x - 0.1, y - 0.06, x + 0.06, y + 0.1))
    np.testing.assert_allclose(near.picks[0].position, whole.picks[0].position, atol=0.003)
    assert near.heightmap.height.shape == (64, 64)


def test_what_was_there_before_is_not_picked(image: dict, highest: TrainedModel, robot: SimulatedRobot) -> None:
    empty = image["depth"].copy()
    empty[100:] = np.where(np.arange(empty.shape[1]) < 320, empty[100:], empty[100:] + 0.03)  # in the left half all stays
    found = see2act.predict(**image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS, background_depth=empty)
    assert found.picks
    assert min(pick.u for pick in found.picks) >= 318
    nothing = see2act.predict(
        **image, checkpoint=highest, pose=robot.camera.pose, bounds=BOUNDS, background_depth=image["depth"]
    )
    assert nothing.picks == ()


@pytest.fixture(scope="module")
def model_file(config: Callable[..., DictConfig], tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    def make(primitive: str) -> Path:
        cfg = config(f"primitive={primitive}", "model.width=4", "precision=fp32")
        torch.manual_seed(0)
        path = tmp_path_factory.mktemp("model") / model_files.FILE
        model_files.save(path, instantiate(cfg.model.network), cfg)
        return path

    return make


def test_a_file_gives_back_what_learned(model_file: Callable[[str], Path], seen: Observation, config: Callable) -> None:
    model = model_files.load(model_file("grasp"), "grasp")
    model.network.set_precision("fp32")
    cfg = config("primitive=grasp", "model.width=4")
    torch.manual_seed(0)
    module = make_module(instantiate(cfg.model.network), shape=seen.heightmap.height.shape, angles=16)
    ours, theirs = (m.affordances(seen.heightmap.color, seen.heightmap.height) for m in (model, module))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert (model.primitive, model.pixel) == ("grasp", 0.0025)
    assert OmegaConf.select(model.config, "paths") is None


def test_bounds_of_whole_pixels_are_kept() -> None:
    side = 0.4 - 0.1  # a little more than 0.3
    assert _workspace((side, side), 0.0025).shape == (120, 120)
    assert _workspace((0.301, 0.3), 0.0025).shape == (120, 121)


def test_a_grasp_s_angle_is_that_of_its_best_map(model_file: Callable[[str], Path], image: dict, robot: SimulatedRobot) -> None:
    model = model_files.load(model_file("grasp"))
    best = see2act.predict(**image, checkpoint=model, pose=robot.camera.pose, bounds=BOUNDS, count=1)
    logits = model.affordances(best.heightmap.color, best.heightmap.height)
    logits[
        _blocked(model, instantiate(model.config.primitive.end_effector), best.heightmap, np.ones(best.objects.shape, bool))
    ] = -np.inf
    pick = best.picks[0]
    assert pick.angle == pytest.approx(logits[:, pick.row, pick.col].argmax() * np.pi / 16)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": "in millimetres"}, "check depth-scale"),
        ({"depth": "smaller"}, "different sizes, 640 x 360 and 320 x 180"),
        ({"depth": "empty"}, "has no reading"),
        ({"intrinsics": np.eye(4)}, "3 x 3"),
        ({"pose": np.zeros((4, 4))}, "camera to world"),
        ({"bounds": (0.1, 0.1, -0.1, 0.2)}, "smallest x, smallest y"),
        ({"bounds": (5.0, 5.0, 5.1, 5.1)}, "between the bounds"),
        ({"bounds": (-9.0, -9.0, 9.0, 9.0)}, "too much"),
        ({"color": np.zeros((360, 640), np.uint8)}, "8-bit RGB"),
        ({"depth": "twice"}, "check pose, depth-scale and bounds|check depth-scale"),
        ({"depth": "six times", "pose": None, "bounds": (-0.7, -0.7, 0.7, 0.7)}, r"more than 0\.3 m.*check depth-scale"),
        ({"depth": "a row", "pose": None, "bounds": None}, "edge-on"),
        ({"background_depth": "far"}, "check pose, depth-scale and bounds|between the bounds"),
        ({"background_depth": np.zeros((9, 9))}, "background depth have different sizes"),
        ({"bounds": (np.nan, 0, 0.1, 0.1)}, "not all numbers"),
        ({"intrinsics": "transposed"}, "pinhole matrix"),
        ({"intrinsics": "skewed"}, "pinhole matrix"),
        ({"intrinsics": "of half the size"}, "not within 6 cm of 0|no level floor"),
        ({"intrinsics": "normalised"}, "pinhole|principal point"),
        ({"intrinsics": np.full((3, 3), np.nan)}, "pinhole matrix"),
        ({"pose": "inverted"}, "invert it"),
        ({"pose": "mirrored"}, "must not mirror"),
    ],
)
def test_bad_input_names_the_mend(
    image: dict, highest: TrainedModel, robot: SimulatedRobot, change: dict[str, Any], words: str
) -> None:
    depth, intrinsics, pose = image["depth"], image["intrinsics"], robot.camera.pose
    row = np.where(np.arange(len(depth))[:, None] == 180, depth, 0)
    bad = {
        "depth": {
            "in millimetres": depth * 1000,
            "smaller": depth[::2, ::2],
            "empty": depth * 0,
            "twice": depth * 2,
            "six times": depth * 6,
            "a row": row,
        },
        "background_depth": {"far": depth * 3},
        "intrinsics": {
            "transposed": intrinsics.T,
            "skewed": intrinsics + [[0, 50, 0], [0, 0, 0], [0, 0, 0]],
            "of half the size": np.diag([0.5, 0.5, 1]) @ intrinsics,
            "normalised": np.diag([1 / 640, 1 / 360, 1]) @ intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]],
        },
        "pose": {"inverted": np.linalg.inv(pose), "mirrored": pose @ np.diag([-1.0, 1, 1, 1])},
    }
    given = {"pose": pose, "bounds": BOUNDS, **image, **change}
    given = {key: bad[key][value] if isinstance(value, str) else value for key, value in given.items()}
    with pytest.raises(ImageError, match=words) as told:
        see2act.predict(**given, checkpoint=highest)
    assert "\n" not in str(told.value)


@pytest.fixture
def files(image: dict, tmp_path: Path, model_file: Callable[[str], Path]) -> dict[str, str]:
    """The options of the command, all well."""
    cv2.imwrite(str(tmp_path / "color.png"), cv2.cvtColor(image["color"], cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(tmp_path / "depth.png"), np.rint(image["depth"] * 1e4).astype(np.uint16))
    np.savetxt(tmp_path / "intrinsics.txt", image["intrinsics"])
    return {
        "--checkpoint": str(model_file("grasp")),
        "--color": str(tmp_path / "color.png"),
        "--depth": str(tmp_path / "depth.png"),
        "--depth-scale": "10000",
        "--intrinsics": str(tmp_path / "intrinsics.txt"),
        "--out": str(tmp_path / "out"),
    }


def _command(files: dict[str, str]) -> list[str]:
    return [word for pair in files.items() for word in pair]


def test_the_command_leaves_picks_and_a_picture(files: dict[str, str], capsys: pytest.CaptureFixture) -> None:
    main([*_command(files), "--count", "3"])
    out = Path(files["--out"])
    told = json.loads((out / "picks.json").read_text())
    assert [pick.keys() >= {"row", "col", "u", "v", "position", "angle", "score"} for pick in told["picks"]] == [True] * 3
    picture = cv2.imread(str(out / "picks.png"))
    assert picture.shape[0] == 360
    assert picture.shape[1] > 640
    said = capsys.readouterr().out
    assert said.count("score") == 3
    assert "jaws along" in said


def test_the_command_does_what_the_function_does(
    files: dict[str, str], image: dict, robot: SimulatedRobot, tmp_path: Path
) -> None:
    """With every option: what is typed arrives, in the units it was typed in."""
    raised = robot.camera.pose.copy()
    raised[2, 3] += 0.1
    np.savetxt(tmp_path / "pose.txt", raised)
    empty = np.where(image["depth"] > 0, robot.camera.floor_depth(), 0)
    cv2.imwrite(str(tmp_path / "empty.png"), np.rint(empty * 1e4).astype(np.uint16))
    bounds = (-0.15, -0.18, 0.18, 0.17)
    options = {"--pose": str(tmp_path / "pose.txt"), "--background-depth": str(tmp_path / "empty.png"), "--floor": "0.1"}
    main([*_command(files | options), "--bounds", *map(str, bounds), "--count", "4", "--apart", "0.03", "--per-object", "3"])
    told = json.loads((Path(files["--out"]) / "picks.json").read_text())
    given = {**image, "depth": np.rint(image["depth"] * 1e4) / 1e4, "background_depth": np.rint(empty * 1e4) / 1e4}
    found = see2act.predict(
        **given, checkpoint=files["--checkpoint"], pose=raised, bounds=bounds, floor=0.1, count=4, apart=0.03, per_object=3
    )
    places = [(pick.row, pick.col, pick.object) for pick in found.picks]
    assert [(pick["row"], pick["col"], pick["object"]) for pick in told["picks"]] == places
    assert len(places) == 3  # all in one heap, where objects touch
    assert told["heightmap"]["floor"] == pytest.approx(0.1, abs=1e-4)
    np.testing.assert_allclose(told["camera_to_world"], raised)
    assert all(pick["position"][2] > 0.1 + 0.004 for pick in told["picks"])  # what was there before is not picked


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--depth-scale", "1", "check depth-scale"),
        ("--depth-scale", "0", "--depth-scale 0 must be a number above 0"),
        ("--intrinsics", "nowhere.txt", "nowhere.txt is not there"),
        ("--checkpoint", "nowhere.safetensors", "model.safetensors of a finished run"),
        ("--primitive", "suction", "trained for primitive=grasp, not suction"),
        ("--depth", "the colour", "one channel"),
        ("--color", "the intrinsics", "cannot be read as an image"),
        ("--intrinsics", "the colour", "cannot be read"),
        ("--pose", "the intrinsics", "holds 9 numbers, and a pose is 16"),
        ("--checkpoint", "the colour", "cannot be read as safetensors"),
        ("--depth", "an empty file", "cannot be read"),
        ("--depth", "words", "depth must be a 16-bit PNG"),
        ("--intrinsics", "an empty file", "cannot be read"),
        ("--apart", "0", "--apart 0 must be a number above 0"),
        ("--count", "0", "--count 0 must be a number above 0"),
        ("--per-object", "0", "--per-object 0 must be a number above 0"),
        ("--out", "the colour", "cannot be written"),
    ],
)
def test_bad_files_are_refused_in_one_line(files: dict[str, str], option: str, value: str, words: str) -> None:
    folder = Path(files["--color"]).parent
    (folder / "empty.npy").touch()
    np.save(folder / "words.npy", np.array([["a", "b"]]))
    known = {"the colour": files["--color"], "the intrinsics": files["--intrinsics"]}
    known |= {"an empty file": str(folder / "empty.npy"), "words": str(folder / "words.npy")}
    given = known.get(value, value)
    with pytest.raises(SystemExit, match=words) as told:
        main(_command({**files, option: given}))
    assert str(told.value).count("\n") == 0
    assert not Path(files["--out"]).exists()


def test_picks_that_cannot_be_written_are_told_in_one_line(files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SystemExit, match=r"No space left on device.*free some space"):
        main([*_command(files), "--count", "3"])


def test_a_photograph_that_was_held_upside_down_is_not_turned(files: dict[str, str]) -> None:
    """Its EXIF says so, and the depth has no such note."""
    jpeg = Path(files["--color"]).with_suffix(".jpg")
    cv2.imwrite(str(jpeg), cv2.imread(files["--color"]))
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"  # orientation 3
    data = jpeg.read_bytes()
    jpeg.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    upright = cv2.imread(files["--color"]).astype(int)
    assert np.abs(cv2.imread(str(jpeg)).astype(int) - upright).mean() > 10  # so OpenCV itself obeys
    args = argparse.Namespace(**{name[2:].replace("-", "_"): Path(value) for name, value in files.items()})
    args.color, args.depth_scale, args.count, args.apart, args.pose, args.background_depth = jpeg, 1e4, 1, 0.1, None, None
    args.per_object, args.intrinsics = None, str(args.intrinsics)
    read = cv2.cvtColor(_read(args)["color"], cv2.COLOR_RGB2BGR).astype(int)
    assert np.abs(read - upright).mean() < 3


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("model.network._target_", "shutil.copy", "holds no model of this version"),
        ("model.network._target_", "torch.nn.Linear", "is no network"),
        ("model.network._target_", "nobody.has.This", "on PYTHONPATH"),
        ("model.network.width", {"_target_": "os.getcwd"}, "numbers and words"),
        ("model.network.width", 8, "holds no model of this version"),
    ],
)
def test_a_file_cannot_have_anything_called_but_a_network(
    model_file: Callable[[str], Path], tmp_path: Path, key: str, value: Any, words: str
) -> None:
    path = model_file("suction")
    metadata = dict(model_files._metadata(path))
    config = OmegaConf.create(json.loads(metadata[model_files.CONFIG]))
    OmegaConf.update(config, key, value)
    metadata[model_files.CONFIG] = json.dumps(OmegaConf.to_container(config))
    save_file(load_file(path), tmp_path / "bad.safetensors", metadata)
    with pytest.raises(ModelFileError, match=words) as told:
        model_files.load(tmp_path / "bad.safetensors")
    assert "\n" not in str(told.value)
    del metadata[model_files.HASH]
    metadata[model_files.CONFIG] = model_files._metadata(path)[model_files.CONFIG]
    save_file(load_file(path), tmp_path / "bad.safetensors", metadata)
    with pytest.raises(ModelFileError, match="holds no model of this version"):
        model_files.load(tmp_path / "bad.safetensors")


def test_weights_without_their_configuration_are_refused(tmp_path: Path) -> None:
    save_file({"weight": torch.zeros(1)}, tmp_path / "bare.safetensors")
    with pytest.raises(ModelFileError, match="says nothing of its configuration"):
        model_files.load(tmp_path / "bare.safetensors")
