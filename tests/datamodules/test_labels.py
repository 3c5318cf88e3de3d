from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import ndimage

from see2act.datamodules.labels import View, plane_fit
from see2act.experiment import build
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import Heightmap

TASKS = ("edge", "corner", "center", "foreground", "normal")


@pytest.fixture(scope="module")
def views(make_robot: Callable[..., SimulatedRobot]) -> list[tuple[View, int]]:
    """Noisy views of real scenes, with the number of objects in them."""
    robot = make_robot("primitive=grasp")
    background = robot.background()
    views = []
    for seed, count in ((1, 10), (2, 6), (3, 1)):
        robot.reset(seed, "seen", count)
        truth = robot.truth()
        views.append((View(robot.observe().heightmap, truth.heightmap, truth.body, background), count))
    return views


def _label(config: Callable, name: str, view: View, means: str) -> np.ndarray:
    return build.task(config(f"task={name}")).label(view, means)


@pytest.mark.parametrize("means", ["truth", "vision"])
@pytest.mark.parametrize("name", TASKS)
def test_every_task_labels_some_pixels_and_not_all(config: Callable, views: list, name: str, means: str) -> None:
    for view, _ in views[:2]:
        label = _label(config, name, view, means)
        assert label.dtype == bool
        assert label.shape == (144, 144)
        assert 0.001 < label.mean() < 0.5


def test_foreground_by_vision_agrees_with_truth(config: Callable, views: list) -> None:
    for view, _ in views:
        truth, vision = (_label(config, "foreground", view, means) for means in ("truth", "vision"))
        assert (truth & vision).sum() / (truth | vision).sum() >= 0.85


@pytest.mark.parametrize("pixel", [0.0025, 0.00125])
def test_foreground_and_corners_by_vision_are_not_shifted(config: Callable, pixel: float) -> None:
    color, height = np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), np.float32)
    empty = Heightmap(color, height, np.ones((60, 60), bool))
    square = np.zeros((60, 60), bool)
    square[20:40, 20:40] = True
    sensed = Heightmap(color + 200 * square[..., None].astype(np.uint8), height + 0.03 * square.astype(np.float32), empty.valid)
    view = View(sensed, sensed, np.where(square, 0, -1), empty)
    for task in ("foreground", "corner"):
        label = build.task(config(f"task={task}", f"workspace.pixel={pixel}")).label(view, "vision")
        assert np.argwhere(label).mean(0) == pytest.approx((29.5, 29.5)), task


def test_a_center_for_every_visible_object(config: Callable, views: list) -> None:
    for view, _ in views:
        visible = [b for b in np.unique(view.body[view.body >= 0]) if (view.body == b).sum() * 0.0025**2 >= 0.0002]
        label = _label(config, "center", view, "truth")
        _, pieces = ndimage.label(label)
        assert 0.6 * len(visible) <= pieces <= len(visible)  # discs of neighbours may touch
        for body in visible:
            row, col = np.argwhere(view.body == body).mean(0).round().astype(int)
            assert label[row, col]


def test_a_lone_object_has_its_center_in_its_middle(config: Callable, views: list) -> None:
    view, _ = views[2]
    for means in ("truth", "vision"):
        middle = np.argwhere(_label(config, "center", view, means)).mean(0)
        assert np.abs(middle - np.argwhere(view.body >= 0).mean(0)).max() < 2.5


def test_normals_are_flat_tops_of_objects(config: Callable, views: list) -> None:
    for view, _ in views:
        label = _label(config, "normal", view, "truth")
        assert (view.body[label] >= 0).all()
        by_vision = _label(config, "normal", view, "vision")
        assert (view.body[by_vision] >= 0).mean() > 0.95


def test_plane_fit_measures_tilt_and_roughness() -> None:
    row, col = np.mgrid[:40, :40] * 0.0025
    tilt, rms = plane_fit(0.3 * col + 0.4 * row + 0.02, 0.0025, 4)
    assert np.allclose(tilt[5:-5, 5:-5], np.arctan(0.5))
    assert rms[5:-5, 5:-5].max() < 1e-6
    noisy = np.random.default_rng(0).normal(0, 0.002, (200, 200))
    tilt, rms = plane_fit(noisy, 0.0025, 4)
    assert np.median(rms) == pytest.approx(0.002, rel=0.05)


def test_edges_lie_on_borders_of_objects(config: Callable, views: list) -> None:
    view, _ = views[0]
    edge = _label(config, "edge", view, "truth")
    body = np.where(view.body >= 0, view.body, -1)
    border = ndimage.maximum_filter(body, 5) != ndimage.minimum_filter(body, 5)
    assert border[edge].mean() > 3 * border.mean()
