"""Each network acts and learns, from weights as a user would bring them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import timm
import torch
from safetensors.torch import save_file
from torchvision.models.detection import fasterrcnn_resnet50_fpn

from see2act.modules.nanodet import NanoDet
from see2act.modules.nanodet_weights import FILE as NANODET
from see2act.modules.transfer import AVERAGE
from tests.jobs import train

COCO = (
    "logger=none",
    "model=rpn_r50_fpn",
    "task=coco",
    "finetune.attempts=2",
)
RUN = ("task=foreground", "primitive=grasp", "finetune.attempts=6", "finetune.episode_attempts=3")

pytestmark = pytest.mark.slow


def test_the_baseline_and_a_fixed_transfer(tmp_path: Path, cache: Path) -> None:
    train(
        tmp_path / "none", cache, "logger=tensorboard", "task=none", "transfer=none", "finetune.attempts=2", "robot.video=true"
    )
    assert (tmp_path / "none" / "video.mp4").stat().st_size > 10_000
    assert not json.loads((tmp_path / "none" / "transfer.json").read_text())["copied"]
    assert not (tmp_path / "none" / "checkpoints" / "vision.ckpt").exists()
    assert list((tmp_path / "none").rglob("events.out.tfevents.*"))
    train(tmp_path / "fixed", cache, "logger=csv", "task=normal", "transfer=fixed")
    assert list((tmp_path / "fixed").rglob("metrics.csv"))
    result = json.loads((tmp_path / "fixed" / "result.json").read_text())
    assert result["eval"]["repeated"] is True
    assert result["eval"]["seen"] == result["zero_shot"]["seen"]
    assert [e["step"] for e in result["evals"]] == [0]
    assert {p.name for p in (tmp_path / "fixed" / "checkpoints").iterdir()} == {
        "vision.ckpt",
        "affordance.ckpt",
        "model.safetensors",
    }
    assert result["curve"] == []


def test_off_the_shelf_weights_from_a_file(tmp_path: Path, cache: Path) -> None:
    """As a user would bring them; random values in the true layout."""
    file = tmp_path / "fasterrcnn.pth"
    torch.manual_seed(0)
    torch.save(fasterrcnn_resnet50_fpn(weights=None, weights_backbone=None).state_dict(), file)
    folder = tmp_path / "coco"
    train(folder, cache, *COCO, f"task.weights={file}", "transfer=fixed")
    report = json.loads((folder / "transfer.json").read_text())
    assert list(report["set_to_zero"]) == ["backbone.depth.weight"]
    assert set(report["left_at_initialisation"]) == {AVERAGE}
    assert report["copied"]["head.cls_logits.weight"] == [3, 256, 1, 1]
    assert (folder / "result.json").exists()


def test_nanodet_acts_and_learns_from_the_cache_s_weights(tmp_path: Path, cache: Path) -> None:
    torch.manual_seed(0)
    (cache / NANODET).parent.mkdir(exist_ok=True)
    save_file({key: value for key, value in NanoDet(depth="none").state_dict().items() if key != AVERAGE}, cache / NANODET)
    few = ("finetune.attempts=1", "evaluate.attempts.seen=1", "evaluate.attempts.unseen=1")
    train(tmp_path / "coco", cache, "logger=none", "model=nanodet_g", "task=coco", "transfer=full", "primitive=suction", *few)
    report = json.loads((tmp_path / "coco" / "transfer.json").read_text())
    assert list(report["set_to_zero"]) == ["backbone.depth.weight"]
    assert set(report["left_at_initialisation"]) == {AVERAGE}
    assert report["copied"]["head.logits.weight"] == [80, 128, 1, 1]
    assert (tmp_path / "coco" / "figures" / "heatmaps.png").exists()


def test_a_backbone_of_timm_acts_and_learns_from_its_weights(tmp_path: Path, cache: Path) -> None:
    file = tmp_path / "weights.pth"
    torch.save(timm.create_model("test_resnet").state_dict(), file)
    few = ("logger=none", "model=timm_fpn", "finetune.attempts=1", "evaluate.attempts.seen=1", "evaluate.attempts.unseen=1")
    resnet = ("model.backbone=test_resnet", "task=imagenet", f"task.weights={file}", "transfer=backbone", "primitive=suction")
    train(tmp_path / "imagenet", cache, *few, *resnet)
    report = json.loads((tmp_path / "imagenet" / "transfer.json").read_text())
    assert report["copied"]["backbone.body.conv1.0.weight"][1] == 4
    assert {key.split(".")[1] for key in report["left_at_initialisation"] if key.startswith("backbone")} == {"fpn"}


def test_the_rpn_learns_to_see_and_to_act(tmp_path: Path, cache: Path) -> None:
    rpn = ("model=rpn_r50_fpn", "model.backbone=resnet18", "task=foreground", "primitive=grasp", "primitive.angles=4")
    few = ("finetune.attempts=1", "evaluate.attempts.seen=1", "evaluate.attempts.unseen=1")
    train(tmp_path / "rpn", cache, "logger=none", *rpn, *few)
    report = json.loads((tmp_path / "rpn" / "transfer.json").read_text())
    assert not report["left_at_initialisation"]
    assert (tmp_path / "rpn" / "result.json").exists()
