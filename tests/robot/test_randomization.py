from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hydra.utils import instantiate

from see2act.robot.camera import Camera
from see2act.robot.oracle import ExactHeights
from see2act.robot.randomization import Randomization
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.types import RobotError
from see2act.seeding import generator

ON = ("camera=top", "camera.randomize=true")
EXACT = {"position": 0.0, "rotation": 0.0, "depth_scale": 0.0, "noise": 1.0, "holes": 1.0}
"""Ranges that leave only the light."""


def ranges(**changes: float) -> list[str]:
    """Overrides with nothing randomized but the light and what is named."""
    return [f"camera.randomization.{name}={value}" for name, value in {**EXACT, **changes}.items()]


@pytest.fixture(scope="module")
def plain(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    return make_robot("camera=top")


@pytest.fixture(scope="module")
def moved(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    """Its camera is up to 2 cm from where it is known to be."""
    return make_robot(*ON, *ranges(position=0.02))


@pytest.fixture(scope="module")
def lit(make_robot: Callable[..., SimulatedRobot]) -> SimulatedRobot:
    """Nothing but its light is randomized."""
    return make_robot(*ON, *ranges())


@pytest.fixture
def camera(config: Callable) -> Camera:
    built: Camera = instantiate(config("camera=d415", "camera.randomize=true").camera, _convert_="all")
    return built


def test_a_camera_is_as_known_unless_it_is_randomized(camera: Camera) -> None:
    known = replace(camera, randomize=False)
    assert known.randomized(np.random.default_rng(0)) is known
    assert camera.randomized(np.random.default_rng(0)) != camera


def test_a_scene_has_its_own_camera_light_and_noise_by_its_seed(camera: Camera) -> None:
    first, again, other = (camera.randomized(generator("randomization", seed)) for seed in (1, 1, 2))
    assert first == again
    for name in ("position", "target", "up", "noise", "light", "depth_scale"):
        assert getattr(first, name) != getattr(other, name), name


def test_all_that_is_drawn_lies_in_its_range() -> None:
    given = Randomization()
    drawn = [given.draw(np.random.default_rng(seed)) for seed in range(200)]
    lights = [one.light for one in drawn]
    for values, low, high in (
        ([one.position for one in drawn], -given.position, given.position),
        ([one.rotation for one in drawn], -given.rotation, given.rotation),
        ([one.depth_scale for one in drawn], 1 - given.depth_scale, 1 + given.depth_scale),
        ([one.sigma for one in drawn], 1 / given.noise, given.noise),
        ([(one.edge_rate, one.grazing_rate) for one in drawn], 1 / given.holes, given.holes),
        ([light.direction[2] for light in lights], np.cos(given.tilt), 1.0),
        ([light.color for light in lights], 1 - given.color, 1 + given.color),
        ([light.ambient for light in lights], *given.ambient),
        ([light.diffuse for light in lights], *given.diffuse),
    ):
        assert low <= np.min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < np.max(values) <= high
    assert np.allclose(np.linalg.norm([light.direction for light in lights], axis=1), 1)


def test_rates_stay_rates(camera: Camera) -> None:
    wild = replace(camera, randomization=Randomization(holes=100.0))
    noises = [wild.randomized(np.random.default_rng(seed)).noise for seed in range(50)]
    assert max(noise.edge_rate for noise in noises) == max(noise.grazing_rate for noise in noises) == 1.0


def test_the_bin_is_in_the_picture_from_wherever_the_camera_is(camera: Camera) -> None:
    camera = replace(camera, randomization=Randomization(position=0.02, rotation=0.02))
    corners = np.array([(x, y, z) for x in (-0.18, 0.18) for y in (-0.13, 0.13) for z in (0, 0.17)])
    cropped = camera.cropped_to(corners)
    rows, cols = cropped.shape
    assert rows < camera.height
    nearest = np.inf
    for seed in range(300):
        moved = cropped.randomized(np.random.default_rng(seed))
        x, y, z = (np.column_stack([corners, np.ones(8)]) @ np.linalg.inv(moved.pose).T)[:, :3].T
        u, v = (moved.focal * axis / z + centre for axis, centre in zip((x, y), moved.intrinsics[:2, 2], strict=True))
        nearest = min(nearest, u.min(), v.min(), (cols - u).min(), (rows - v).min())
    assert nearest >= 4
    assert camera.cropped_to(corners).shape > replace(camera, randomize=False).cropped_to(corners).shape


def test_the_heightmap_is_off_by_as_much_as_the_camera(moved: SimulatedRobot, plain: SimulatedRobot) -> None:
    for robot in (moved, plain):
        robot.reset(4, "seen")
    off = np.subtract(moved._present_camera.position, moved.camera.position)
    assert np.abs(off).max() > 0.005
    shown, known = moved.truth(), plain.truth()
    floor = (known.body < 0) & (shown.body < 0) & shown.heightmap.valid
    floor[:16] = floor[-16:] = floor[:, :16] = floor[:, -16:] = False  # no walls
    assert np.median(shown.heightmap.height[floor]) == pytest.approx(-off[2], abs=5e-4)
    shifts = []
    for there, here in zip(moved.scene.bodies, plain.scene.bodies, strict=True):
        cells = [np.argwhere(truth.body == body.id) for truth, body in ((shown, there), (known, here))]
        if min(map(len, cells)) > 100:
            shifts.append(np.subtract(*(moved.workspace.to_world(*one.mean(0)) for one in cells)))
    assert len(shifts) > 3
    assert np.median(shifts, axis=0) == pytest.approx(-off[:2], abs=2e-3)


def test_labels_fit_what_is_sensed_not_where_things_are(moved: SimulatedRobot) -> None:
    moved.reset(4, "seen")
    seen, truth = moved.observe().heightmap, moved.truth().heightmap
    both = seen.valid & truth.valid
    assert np.median(np.abs(seen.height - truth.height)[both]) < 0.001
    assert np.median(np.abs(truth.height - ExactHeights(moved).height)[both]) > 0.003


def test_the_depth_s_scale_is_in_the_image_and_in_the_labels(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot(*ON, *ranges(depth_scale=0.1))
    robot.reset(4, "seen")
    scale = robot._present_camera.depth_scale
    assert abs(scale - 1) > 0.01
    _, exact, _ = robot._look()
    sensed = robot.observe().depth
    read = sensed > 0
    assert np.median(sensed[read] / exact[read]) == pytest.approx(scale, abs=1e-3)
    eye = robot.camera.position[2]
    assert np.median(robot.truth().heightmap.height) == pytest.approx(eye - scale * eye, abs=1e-3)


def test_nothing_else_is_drawn_differently(lit: SimulatedRobot, plain: SimulatedRobot) -> None:
    for robot in (lit, plain):
        robot.reset(6, "unseen")
    assert lit.scene.layout() == plain.scene.layout()
    seen, known = lit.observe(), plain.observe()
    assert np.array_equal(seen.depth, known.depth)
    assert (seen.color != known.color).mean() > 0.3


def test_the_empty_bin_is_seen_as_if_nothing_were_randomized(lit: SimulatedRobot, plain: SimulatedRobot) -> None:
    lit.reset(6, "unseen")
    lit.observe()  # the renderer remembers the light
    empty, known = lit.background(), plain.background()
    assert np.array_equal(empty.color, known.color)
    assert np.array_equal(empty.height, known.height)


@pytest.mark.parametrize("limits", [0.5, (0.7, 0.4), (-0.1, 0.4), ("a", "b"), (0.1, 0.2, 0.3)])
@pytest.mark.parametrize("name", ["ambient", "diffuse"])
def test_a_range_is_two_numbers_in_order(name: str, limits: object) -> None:
    with pytest.raises(RobotError, match=rf"camera\.randomization\.{name}=.* is no range: give \[least,most\]"):
        Randomization(**{name: limits})  # type: ignore[arg-type]
