"""A run that starts from the affordance model of another one: it picks as that one did in the end, before it learns more."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from see2act.errors import ConfigError, UserError
from see2act.experiment import build
from see2act.experiment.checks import validate
from see2act.experiment.config import composed
from see2act.experiment.identity import config_hash
from see2act.experiment.results import read_result
from see2act.experiment.single import run_checked
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.pretrain import vision_model
from see2act.experiment.stages.transfer import affordance_model, check_weights
from see2act.modules.affordance import AffordanceModule
from see2act.modules.batchnorm import batchnorms
from tests.attended import Table, configured


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def made(folder: Path, *overrides: str) -> DictConfig:
    return configured(f"collect.folder={folder}/observations", f"paths.cache={folder}/cache", *overrides)


@pytest.fixture(scope="module")
def first(folder: Path) -> DictConfig:
    """Of a finished run from scratch; its folder is ``first``."""
    Table.prepare()
    cfg = made(folder, "task=none", "transfer=none", "finetune.attempts=5", "finetune.averaging=0.5", "seed=3")
    (folder / "first").mkdir()
    run_checked(cfg, folder / "first")
    return cfg


def starting(cfg: DictConfig, folder: Path) -> AffordanceModule:
    """The affordance model of a run before its first attempt."""
    collection = collected(cfg) if build.needs_observations(cfg) else None
    vision = vision_model(cfg, collection, partial(build.trainer, cfg, folder, None))
    return affordance_model(cfg, collection, vision)[0]


def seen(cfg: DictConfig) -> tuple[np.ndarray, np.ndarray]:
    robot = build.robot_factory(cfg, cfg.primitive)()
    robot.reset(7, "unseen")
    heightmap = robot.observe().heightmap
    return heightmap.color, heightmap.height


@pytest.mark.parametrize("given", ["first", "first/checkpoints/model.safetensors"])
def test_it_starts_where_the_other_run_ended(first: DictConfig, folder: Path, given: str) -> None:
    ended = starting(first, folder)
    before = ended.affordances(*seen(first))
    ended.load_state_dict(torch.load(folder / "first/checkpoints/affordance.ckpt", weights_only=True)["state_dict"])
    after = ended.affordances(*seen(first))
    assert not np.allclose(before, after), "it has learned nothing, so this shows nothing"
    again = starting(made(folder, "task=affordance", "transfer=full", f"task.weights={folder}/{given}"), folder)
    assert np.array_equal(again.affordances(*seen(first)), after)


@pytest.mark.usefixtures("first")
@pytest.mark.parametrize("transfer", ["full", "fixed"])
def test_nothing_is_collected_for_a_model_that_is_copied_whole(folder: Path, transfer: str) -> None:
    Table.prepare()
    (folder / transfer).mkdir()
    overrides = ("task=affordance", f"transfer={transfer}", f"task.weights={folder}/first", "finetune.attempts=2")
    run_checked(made(folder, *overrides, f"collect.folder={folder}/nothing"), folder / transfer)
    assert not (folder / "nothing").exists()
    assert Table.count("fill") == (2 if transfer == "fixed" else 3)
    result = read_result(folder / transfer / "result.json")
    assert (result.choices["task"], result.vision) == ("affordance", None)
    report = json.loads((folder / transfer / "transfer.json").read_text())
    assert report["left_at_initialisation"] == report["unused"] == {}
    assert not (folder / transfer / "checkpoints" / "vision.ckpt").exists()


@pytest.mark.usefixtures("first")
def test_a_backbone_alone_gets_a_new_head_with_statistics(folder: Path) -> None:
    cfg = made(folder, "task=affordance", "transfer=backbone", f"task.weights={folder}/first")
    module = starting(cfg, folder)
    whole = starting(made(folder, "task=affordance", "transfer=full", f"task.weights={folder}/first"), folder)
    ours, theirs = module.network.state_dict(), whole.network.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours if key.startswith(("backbone.", "normalization.")))
    assert not any(torch.equal(ours[key], theirs[key]) for key in ours if key.startswith("head.") and ours[key].dim() == 4)
    fresh = [layer for name, layer in batchnorms(module.network).items() if name.startswith("head.")]
    assert all(layer.running_mean.abs().max() > 0 for layer in fresh)


@pytest.mark.usefixtures("first")
def test_a_simulated_robot_starts_from_it_too(folder: Path, config: Callable[..., DictConfig]) -> None:
    source, size = ("task=affordance", f"task.weights={folder}/first"), ("workspace.width=0.36", "workspace.length=0.36")
    simulated = config(*source, "model.width=4", "precision=fp32")
    validate(simulated)
    check_weights(simulated)
    rng = np.random.default_rng(0)
    heightmap = rng.integers(0, 255, (144, 144, 3), np.uint8), rng.random((144, 144), np.float32) * 0.05
    maps = [starting(cfg, folder).affordances(*heightmap) for cfg in (simulated, made(folder, *source, *size))]
    assert np.array_equal(*maps)


@pytest.mark.usefixtures("first")
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("model.width=8", r"learned with model\.network\.width=4, not 8: type the same model="),
        ("primitive=grasp", "was trained for primitive=suction, not grasp"),
        ("primitive.end_effector.cup_radius=0.02", r"learned with primitive\.end_effector\.cup_radius=0\.009, not 0\.02"),
        ("workspace.pixel=0.0015", r"learned with workspace\.pixel=0\.0025, not 0\.0015"),
        ("task.weights=nowhere", r"nowhere is not there: give checkpoints/model\.safetensors of a finished run"),
    ],
)
def test_what_does_not_fit_is_refused_before_any_work(folder: Path, override: str, words: str) -> None:
    cfg = made(folder, "task=affordance", "transfer=full", f"task.weights={folder}/first", override)
    with pytest.raises(UserError, match=words) as error:
        check_weights(cfg)
    assert "\n" not in str(error.value)


def test_it_must_be_said_which_run(config: Callable[..., DictConfig]) -> None:
    with pytest.raises(ConfigError, match=r"task=affordance starts from a run: name its folder with task\.weights="):
        validate(config("task=affordance", "transfer=full"))


@pytest.mark.usefixtures("first")
def test_the_hash_is_of_the_model_and_not_of_its_place(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    model = tmp_path / "checkpoints" / "model.safetensors"
    model.write_bytes((folder / "first/checkpoints/model.safetensors").read_bytes())

    def hash_with(weights: Path) -> str:
        return config_hash(composed(["precision=fp32", "task=affordance", f"task.weights={weights}"]))

    known = hash_with(folder / "first")
    assert known == hash_with(tmp_path) == hash_with(model)
    model.write_bytes(b"another")
    assert hash_with(model) != known
