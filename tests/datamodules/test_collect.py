from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from see2act.datamodules.collect import ARRAYS, SCENES_IN_A_ROW, Collection, _scenes, collect
from see2act.datamodules.vision import channel_statistics
from see2act.experiment import build
from see2act.robot.types import Heightmap


@pytest.fixture(scope="module")
def collections(config: Callable) -> list[Collection]:
    """The same collection by one worker and by two, each of which makes several scenes."""
    cfg = config()
    factory = build.robot_factory(cfg, cfg.collect.primitive)
    return [collect(factory, SCENES_IN_A_ROW + 1, 1, 10, seed=3, workers=workers) for workers in (1, 2)]


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(collections: list[Collection]) -> None:
    first, second = collections
    assert len(first) == SCENES_IN_A_ROW + 1
    for name in ARRAYS:
        assert np.array_equal(first.arrays[name], second.arrays[name]), name


@pytest.mark.slow
def test_a_scene_does_not_depend_on_those_before_it(config: Callable, collections: list[Collection]) -> None:
    cfg = config()
    alone = _scenes(build.robot_factory(cfg, cfg.collect.primitive), 3, [(2, 1)], 10)[0]
    for name in ARRAYS:
        assert np.array_equal(alone.arrays[name][0], collections[0].arrays[name][2]), name


@pytest.mark.slow
def test_sensed_heights_are_noisy_and_true_ones_are_not(collections: list[Collection]) -> None:
    arrays = collections[0].arrays
    floor = (arrays["body"] < 0) & (arrays["clean_height"] < 0.005) & arrays["valid"] & arrays["clean_valid"]
    assert arrays["clean_height"][floor].std() < 2e-4
    assert 2e-4 < arrays["height"][floor].std() < 2e-3


@pytest.mark.slow
def test_save_and_load(collections: list[Collection], tmp_path: Path) -> None:
    collections[0].save(tmp_path / "c.npz")
    loaded = Collection.load(tmp_path / "c.npz")
    assert all(np.array_equal(loaded.arrays[name], collections[0].arrays[name]) for name in ARRAYS)
    assert np.array_equal(loaded.background.height, collections[0].background.height)
    assert [p.name for p in tmp_path.iterdir()] == ["c.npz"]


@pytest.mark.slow
def test_statistics_are_those_of_the_channels(collections: list[Collection]) -> None:
    mean, std = channel_statistics(collections[0])
    color, height = (collections[0].arrays[name] for name in ("color", "height"))
    assert mean[:3].numpy() == pytest.approx(color.reshape(-1, 3).mean(axis=0) / 255, rel=1e-5)
    assert std[:3].numpy() == pytest.approx(color.reshape(-1, 3).std(axis=0) / 255, rel=1e-5)
    assert mean[3].item() == pytest.approx(height.mean(), rel=1e-3)
    assert std[3].item() == pytest.approx(height.std(), rel=1e-3)
    assert (mean[:3] > 0.1).all()
    assert (mean[:3] < 0.9).all()


def test_statistics_of_channels_that_are_constant() -> None:
    alike = {"color": np.full((3, 4, 4, 3), 200, np.uint8), "height": np.full((3, 4, 4), 0.1, np.float32)}
    mean, std = channel_statistics(Collection(alike, Heightmap(*(np.empty(0),) * 3)))
    assert mean.tolist() == pytest.approx([200 / 255] * 3 + [0.1])
    assert std.tolist() == [1, 1, 1, 1]
