"""Images with the flaws of real depth cameras: boxes on a floor, computed ray by ray, so that what is right is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from omegaconf import DictConfig
from torch import nn

import see2act
from see2act.experiment.model_file import TrainedModel
from see2act.modules.network import PixelNetwork
from see2act.prediction.depth import with_small_holes_filled, without_flying_pixels
from see2act.prediction.objects import sealable, standing
from see2act.prediction.predict import Prediction, ScoredPick

Box = tuple[tuple[float, float], tuple[float, float], float]
"""Ranges of x and of y, and height, metres."""

INTRINSICS = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
BOUNDS = (-0.18, -0.18, 0.18, 0.18)
BOX: Box = ((-0.03, 0.03), (-0.03, 0.03), 0.05)


def _pose(back: float = 0.45, up: float = 0.55) -> np.ndarray:
    """A camera that looks at the middle of the floor from so far back and above."""
    forward = np.array([0, back, -up]) / np.hypot(back, up)
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, [0, -back, up]])
    return pose


def _depth(pose: np.ndarray, *boxes: Box) -> np.ndarray:
    """Depth of the floor and of boxes that stand on it, metres."""
    v, u = np.indices((480, 640), float)
    rays = np.stack([(u - 319.5) / 600, (v - 239.5) / 600, np.ones(u.shape)], -1) @ pose[:3, :3].T
    depth = -pose[2, 3] / rays[..., 2]
    for x, y, top in boxes:
        limits = (np.array([x, y, (0, top)]).T - pose[:3, 3])[:, None, None] / rays
        enter, leave = limits.min(axis=0).max(axis=-1), limits.max(axis=0).min(axis=-1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    return depth.astype(np.float32)


class Liked(nn.Module):
    """Likes heights as told."""

    def __init__(self, liked: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self.liked = liked

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.liked(x[:, 3:])


@pytest.fixture(scope="module")
def picks(config: Callable[..., DictConfig]) -> Callable[..., Prediction]:
    """What a model that likes some heights picks in a depth image."""

    def found(depth: np.ndarray, liked: Callable, primitive: str = "suction", **options: Any) -> Prediction:
        network = PixelNetwork(Liked(liked), nn.Identity(), stride=4, receptive_radius=20)
        model = TrainedModel(network, config(f"primitive={primitive}"), "none")
        options = {"pose": _pose(), "bounds": BOUNDS} | options
        return see2act.predict(np.full((*depth.shape, 3), 90, np.uint8), depth, INTRINSICS, model, **options)

    return found


def _high(height: torch.Tensor) -> torch.Tensor:
    return 10 * height


def _low(height: torch.Tensor) -> torch.Tensor:
    return -10 * height


def _on(pick: ScoredPick, box: Box, slack: float = 0.003) -> bool:
    (x0, x1), (y0, y1), top = box
    x, y, z = pick.position
    return x0 - slack < x < x1 + slack and y0 - slack < y < y1 + slack and -slack < z < top + slack


@pytest.mark.parametrize("known_pose", [True, False])
def test_the_floor_itself_is_not_picked(picks: Callable[..., Prediction], known_pose: bool) -> None:
    depth = _depth(_pose(), BOX)
    options = {} if known_pose else {"pose": None, "bounds": None}
    found = picks(depth, _low, count=50, apart=0.01, **options)
    assert found.picks
    above = [pick.position[2] - found.floor.at(*pick.position[:2]) for pick in found.picks]
    assert min(above) > 0.004
    assert not picks(_depth(_pose()), _low, **options).picks


def test_readings_in_the_air_behind_an_edge_are_no_surface(picks: Callable[..., Prediction]) -> None:
    """As a sensor has them that mixes the depths of three pixels."""
    mixed = cv2.blur(_depth(_pose(), BOX), (3, 3))
    found = picks(mixed, _high, count=20, apart=0.01)
    rows, cols = np.nonzero(found.source >= 0)
    x, y = found.workspace.to_world(rows.astype(float), cols.astype(float))
    away = np.maximum(np.abs(x), np.abs(y)) > 0.03 + 0.005
    assert away.sum() > 5000
    assert found.heightmap.height[rows, cols][away].max() < 0.005
    assert all(_on(pick, BOX, slack=0.005) for pick in found.picks)


def test_a_wire_is_no_reading_in_the_air() -> None:
    depth = np.full((60, 60), 0.6, np.float32)
    depth[:, 30:32] = 0.57
    np.testing.assert_array_equal(without_flying_pixels(depth, INTRINSICS), depth)
    depth[10, 10] = 0.5  # one wrong reading
    depth[40:42, 33] = 0.58  # between the wire and nothing
    depth[40:42, 34] = 0
    mended = without_flying_pixels(depth, INTRINSICS)
    assert mended[10, 10] == 0
    assert not mended[40:42, 33].any()
    assert np.count_nonzero(mended) == 60 * 60 - 1 - 4


def test_speckle_of_the_sensor_is_not_picked(picks: Callable[..., Prediction]) -> None:
    """Both images have patches of readings that are 8 mm too near, at different places, and a wall that trembles."""
    rng = np.random.default_rng(0)
    wall: Box = ((-0.18, 0.18), (0.15, 0.17), 0.08)

    def noisy(depth: np.ndarray) -> np.ndarray:
        near = np.zeros(depth.shape)
        for v, u in rng.integers((150, 150), (400, 500), (60, 2)):
            near[v : v + 4, u : u + 4] = 0.012
        wrong = np.asarray(depth - near, np.float32)
        return np.roll(wrong, int(rng.integers(-1, 2)), axis=0)

    background = noisy(_depth(_pose(), wall))
    depth = noisy(_depth(_pose(), wall, BOX))
    for options in ({"background_depth": background}, {}):
        found = picks(depth, _low, count=30, apart=0.01, **options)
        assert len(found.picks) >= 10
        stray = [pick for pick in found.picks if not _on(pick, BOX, slack=0.01) and pick.position[1] < 0.14]
        assert not stray
    with_background = picks(depth, _low, count=30, apart=0.01, background_depth=background)
    assert all(_on(pick, BOX, slack=0.01) for pick in with_background.picks)  # and so the wall is not


def test_a_missing_patch_on_an_object_is_no_hole_in_it(picks: Callable[..., Prediction]) -> None:
    whole = _depth(_pose(), BOX)
    depth = whole.copy()
    v, u = 214, 320  # on its top
    patch = np.hypot(*(np.indices(depth.shape) - np.array([v, u])[:, None, None])) < 10
    depth[patch] = 0
    found, true = picks(depth, _high, count=40, apart=0.005), picks(whole, _high)
    assert (true.source >= 0)[true.heightmap.height > 0.045].mean() > 0.9
    np.testing.assert_allclose(found.heightmap.height, true.heightmap.height, atol=0.003)
    assert found.picks
    assert not any(patch[pick.v, pick.u] for pick in found.picks)  # it was not seen there


def test_a_large_hole_and_what_an_object_hides_stay_unseen() -> None:
    depth = np.full((200, 200), 0.6, np.float32)
    depth[100:150, 100:150] = 0  # 5 cm
    depth[20:30, 20:30] = 0
    depth[20:30, 30:40] = 0.5
    depth[80, 80] = 0
    depth[80, 81] = 0.55
    mended = with_small_holes_filled(depth, INTRINSICS)
    np.testing.assert_array_equal(mended, depth)
    depth[60:70, 60:70] = 0
    mended = with_small_holes_filled(depth, INTRINSICS)
    np.testing.assert_allclose(mended[60:70, 60:70], 0.6, rtol=1e-5)


def _far_edge(height: torch.Tensor) -> torch.Tensor:
    """High where the height falls away from the camera: what lies there is hidden."""
    farther = nn.functional.pad(height, (0, 0, 3, 0))[:, :, :-3]
    return 100 * (height - farther) * (height > 0.045)


def test_a_cup_is_not_put_where_it_is_half_unseen(picks: Callable[..., Prediction]) -> None:
    found = picks(_depth(_pose(), BOX), _far_edge)
    assert _on(found.picks[0], BOX)
    assert max(pick.position[1] for pick in found.picks if pick.position[2] > 0.02) < 0.03 - 0.004
    known = np.zeros((20, 20), bool)
    known[:, 10:] = True
    np.testing.assert_array_equal(sealable(known, 0.01, 0.0025)[10], (np.arange(20) >= 13) & (np.arange(20) < 17))


def test_fingers_outside_the_image_come_last(picks: Callable[..., Prediction]) -> None:
    """The higher box is too long for the jaws, and across it one finger would go where the camera does not look."""
    pose = _pose(back=0.05)
    border: Box = ((0.24, 0.28), (-0.16, 0.16), 0.05)
    middle: Box = ((-0.02, 0.02), (-0.02, 0.02), 0.04)
    bounds = (-0.4, -0.18, 0.4, 0.18)
    found = picks(_depth(pose, border, middle), _high, "grasp", pose=pose, bounds=bounds)
    first = [pick for pick in found.picks if not pick.blocked]
    last = found.picks[len(first) :]
    assert first
    assert last
    assert all(_on(pick, middle) for pick in first)
    assert all(_on(pick, border) and pick.blocked for pick in last)


def test_picks_can_be_spread_over_objects(picks: Callable[..., Prediction]) -> None:
    tall: Box = ((-0.09, -0.03), (-0.03, 0.03), 0.05)
    flat: Box = ((0.03, 0.09), (-0.03, 0.03), 0.03)
    depth = _depth(_pose(), tall, flat)
    found = picks(depth, _high, count=6, apart=0.015)
    assert all(_on(pick, tall) for pick in found.picks)
    assert len({pick.object for pick in found.picks}) == 1
    assert found.notes[-1].startswith("6 of the 6 picks are on one object")
    spread = picks(depth, _high, count=6, apart=0.015, per_object=2)
    assert [_on(pick, tall) for pick in spread.picks] == [True, True, False, False]
    assert all(_on(pick, flat) for pick in spread.picks[2:])
    assert [pick.object == spread.picks[0].object for pick in spread.picks] == [True, True, False, False]
    assert not any("one object" in note for note in spread.notes)
    np.testing.assert_array_equal(np.unique(spread.objects), [0, 1, 2])


def test_what_stands_on_the_floor_is_numbered_and_specks_are_not() -> None:
    height, known = np.zeros((40, 40), np.float32), np.ones((40, 40), bool)
    height[5:15, 5:15] = 0.02
    height[20:30, 20:30] = 0.02
    height[35:37, 35:37] = 0.02  # 25 square millimetres
    height[20:30, 5:15] = 0.004
    known[:, 25:] = False
    parts = standing(height, np.zeros_like(height), known, 0.0025)
    assert parts[10, 10] == 1
    assert parts[25, 22] == 2
    assert np.count_nonzero(parts) == 100 + 50
