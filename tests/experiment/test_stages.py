"""Stages of a run, each by itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from see2act.datamodules.collect import Collection
from see2act.errors import ConfigError, TransferError
from see2act.experiment import attempts, build
from see2act.experiment.config import composed
from see2act.experiment.context import RunContext
from see2act.experiment.run import _whole
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.evaluate import _Evaluation
from see2act.experiment.stages.pretrain import held_out_labels, vision_model, vision_path
from see2act.experiment.stages.transfer import check_weights
from see2act.modules.nanodet import NanoDet
from see2act.robot.types import Heightmap
from tests.factory import attempt_row
from tests.jobs import TINY


def test_one_vision_model_serves_both_primitives_however_they_learn(config: Callable) -> None:
    def kept(*overrides: str) -> Path:
        return vision_path(config("task=edge", *overrides))

    assert kept("primitive=grasp") == kept("primitive=suction") == kept("primitive.lr=0.1", "finetune.head_lr=0.2")
    others = {kept(), kept("pretrain.lr=0.1"), kept("model.width=4"), kept("task=corner"), kept("labels=vision")}
    assert len(others) == 5


def test_a_vision_model_that_diverged_is_not_kept(tmp_path: Path) -> None:
    cfg = composed([*TINY, "model.width=4", f"paths.cache={tmp_path}", "task=foreground", "pretrain.lr=1e30"])
    with pytest.raises(ConfigError, match=r"the vision model has diverged .*: lower pretrain\.lr"):
        vision_model(cfg, collected(cfg), partial(build.trainer, cfg, tmp_path, None))
    assert not vision_path(cfg).exists()


def test_a_vision_model_that_lacks_what_was_not_transferred_is_not_drawn(config: Callable) -> None:
    cfg = config("task=foreground", "transfer=backbone", "model.width=4")
    network = build.network(cfg, 0)
    before = SimpleNamespace(network=network)
    state = network.state_dict()
    drawn = _whole(cfg, {"network": state}, before)  # type: ignore[arg-type]
    assert drawn is not None
    assert drawn is not before
    backbone = {key: value for key, value in state.items() if not key.startswith("head.")}
    assert _whole(cfg, {"network": backbone}, before) is None  # type: ignore[arg-type]


def test_a_task_that_labels_nothing_held_out_is_refused() -> None:
    color, height, valid = np.zeros((2, 8, 8, 3), np.uint8), np.zeros((2, 8, 8), np.float32), np.ones((2, 8, 8), bool)
    seen = {"color": color, "height": height, "valid": valid}
    bins = {**seen, **{f"clean_{name}": values for name, values in seen.items()}, "body": np.full((2, 8, 8), -1)}
    scenes = Collection(bins, Heightmap(color[0], height[0], valid[0]))
    with pytest.raises(ConfigError, match=r"labels nothing in 2 held-out scenes: raise pretrain\.test_scenes"):
        held_out_labels(composed(["task=foreground", "transfer=full"]), scenes)


def test_folded_batchnorm_does_not_learn_from_batches(config: Callable, tmp_path: Path) -> None:
    state = NanoDet(depth="none").state_dict()
    folded = {key: torch.zeros_like(value) if key.endswith("epsilon") else value for key, value in state.items()}
    save_file(folded, tmp_path / "coco.safetensors")
    coco = ("model=nanodet_g", "task=coco", "transfer=full", f"task.weights={tmp_path / 'coco.safetensors'}")
    check_weights(config(*coco))
    with pytest.raises(TransferError, match=r"leave finetune\.batchnorm=frozen"):
        check_weights(config(*coco, "finetune.batchnorm=batch"))


def test_the_plain_rule_repeats_only_test_runs_with_a_failure(config: Callable, tmp_path: Path) -> None:
    context = RunContext(config("finetune.attempts=6"), tmp_path)
    context.log.begin()
    for split, number, successes in (("seen", 0, (1, 1)), ("seen", 1, (1, 0)), ("unseen", 0, (1,))):
        context.log.append(*(attempt_row(phase="eval", step=6, split=split, run=number, success=bool(s)) for s in successes))
    context.log.append(attempt_row(phase="eval", step=3, split="unseen", run=1))  # of an earlier evaluation
    policy = build.policy(context.cfg).plain()
    known = _Evaluation(context, None, policy, 6)._without_failure()  # type: ignore[arg-type]
    assert {key: len(rows) for key, rows in known.items()} == {("seen", 0): 2, ("unseen", 0): 1}
    added = attempts.read(tmp_path / "attempts.csv")[6:]
    assert [(row.policy, row.split, row.run) for row in added] == [*[("argmax", "seen", 0)] * 2, ("argmax", "unseen", 0)]
