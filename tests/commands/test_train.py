"""Whole jobs, tiny ones: everything is real but the numbers."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
from omegaconf import DictConfig
from safetensors.torch import load_file, save_file
from torchvision.models.detection import fasterrcnn_resnet50_fpn

from see2act.datamodules.collect import Collection
from see2act.errors import ConfigError, TransferError
from see2act.experiment import attempts, build
from see2act.experiment.config import composed
from see2act.experiment.context import RunContext
from see2act.experiment.progress import Progress
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.evaluate import _Evaluation
from see2act.experiment.stages.pretrain import held_out_labels, vision_model, vision_path
from see2act.experiment.stages.transfer import affordance_model, check_weights
from see2act.modules.affordance import AffordanceModule
from see2act.modules.batchnorm import batchnorms
from see2act.modules.nanodet import NanoDet
from see2act.modules.nanodet_weights import FILE as NANODET
from see2act.modules.transfer import AVERAGE
from see2act.robot.types import Heightmap
from tests.factory import attempt_row

TRAIN = Path(__file__).parents[2] / "train.py"
TINY = (
    *(
        "threads=1",
        "collect.interactions=10",
        "pretrain.epochs=1",
        "pretrain.batch_size=4",
        "pretrain.test_scenes=2",
        "finetune.updates=2",
        "finetune.batch_size=4",
    ),
    *("evaluate.attempts.seen=2", "evaluate.attempts.unseen=2", "figures.scenes=1"),
)
PICTURES = {"learning_curve.png", "diagnosis.png", "labels.png", "vision.png", "heatmaps.png", "picks.png"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def _wait(process: subprocess.Popen, until: Callable[[], bool]) -> None:
    """Until something has come about in a process that goes on."""
    deadline = time.monotonic() + 300
    while not until():
        assert process.poll() is None, "it ended too soon"
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _command(folder: Path, cache: Path, *overrides: str) -> list[str]:
    where = (f"hydra.run.dir={folder}", f"paths.cache={cache}")
    return [sys.executable, str(TRAIN), *TINY, *_width(overrides), *where, *overrides]


def _width(overrides: tuple[str, ...]) -> tuple[str, ...]:
    return () if {"model=rpn_r50_fpn", "model=nanodet_g", "model=timm_fpn"} & {*overrides} else ("model.width=4",)


def _train(folder: Path, cache: Path, *overrides: str) -> str:
    done = subprocess.run(_command(folder, cache, *overrides), capture_output=True, text=True, timeout=500, cwd=folder.parent)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def _rows(folder: Path) -> list[dict[str, str]]:
    """Rows of attempts.csv, times aside."""
    if not (folder / "attempts.csv").exists():
        return []
    with (folder / "attempts.csv").open() as file:
        return [{k: v for k, v in row.items() if not k.startswith("t_")} for row in csv.DictReader(file)]


COCO = (
    "logger=none",
    "model=rpn_r50_fpn",
    "task=coco",
    "task.off_the_shelf.rpn_r50_fpn.epsilon=1e-5",
    "finetune.attempts=2",
)
RUN = ("task=foreground", "primitive=grasp", "finetune.attempts=6", "finetune.episode_attempts=3")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("runs") / "first"
    out = _train(folder, cache, "logger=wandb", *RUN)
    return folder, out


def test_a_run_leaves_what_the_design_promises(run: tuple[Path, str]) -> None:
    folder, out = run
    result = json.loads((folder / "result.json").read_text())
    assert result["choices"]["task"] == "foreground"
    assert set(result["seconds"]) >= {"collect", "pretrain", "transfer", "finetune", "evaluate"}
    share = result["seconds"]["evaluate"] / sum(result["seconds"].values())
    assert result["evaluation_share"] == pytest.approx(share, abs=0.001)
    assert set(result["vision"]) == {"positive_share", "val_loss", "average_precision"}
    assert 0 < result["vision"]["average_precision"] <= 1
    for name in ("zero_shot", "eval", "eval_argmax"):
        for split in ("seen", "unseen"):
            part = result[name][split]
            assert part["attempts"] == 2
            assert part["rate"] == part["successes"] / part["attempts"]
            assert [set(r) for r in part["runs"]] == [{"scene_seed", "successes", "attempts", "lost"}]
    assert [e["step"] for e in result["evals"]] == [0, 6]
    assert result["evals"][0]["seen"] == result["zero_shot"]["seen"]
    assert [(c["step"], c["attempts"]) for c in result["curve"]] == [(6, 6)]
    rows = _rows(folder)
    assert [r["step"] for r in rows if r["phase"] == "finetune"] == list("123456")
    assert {r["episode"] for r in rows if r["phase"] == "finetune"} == {"0", "1"}
    assert [r["phase"] for r in rows].count("zero_shot") == 4
    assert {(r["phase"], r["policy"]) for r in rows} == {
        *{("zero_shot", "suppress"), ("finetune", "suppress"), ("eval", "suppress"), ("eval", "argmax")}
    }
    failed = any(r["phase"] == "eval" and r["policy"] == "suppress" and r["success"] == "0" for r in rows)
    assert {p.name for p in (folder / "figures").iterdir()} == PICTURES | ({"failures.png"} if failed else set())
    assert {p.name for p in (folder / "checkpoints").iterdir()} == {
        "vision.ckpt",
        "affordance.ckpt",
        "last.ckpt",
        "model.safetensors",
    }
    assert (folder / ".hydra" / "config.yaml").exists()
    report = json.loads((folder / "transfer.json").read_text())
    assert report["parts"] == ["backbone", "head"]
    assert not report["left_at_initialisation"]
    assert str(folder / "result.json") in out
    assert list((folder / "wandb").glob("offline-run-*"))


def test_the_dashboard_is_read_back(run: tuple[Path, str]) -> None:
    """Curves, evaluations, figures and attempts, from the file that ``wandb sync`` uploads."""
    folder, _ = run
    (offline,) = (folder / "wandb").glob("offline-run-*")
    wandb = [sys.executable, "-m", "wandb", "leet", "inspect", "--json"]
    read = subprocess.run([*wandb, "--summary", str(offline)], capture_output=True, text=True, check=True, timeout=60)
    dashboard = json.loads(read.stdout)
    assert dashboard["config"]["task"]["name"] == "foreground"
    result = json.loads((folder / "result.json").read_text())
    found = json.dumps(dashboard)
    for name in ("vision/loss", "affordance/success", "affordance/entropy", "replay/age", "evaluate/unseen"):
        assert name in found
    assert all(f"figures/{name.removesuffix('.png')}" in found for name in PICTURES)
    assert str(result["eval"]["unseen"]["rate"]) in found
    (table,) = (offline / "files" / "media" / "table").glob("attempts_*.table.json")
    assert len(json.loads(table.read_text())["data"]) == len(_rows(folder))
    assert "lookup" not in "".join(log.read_text() for log in (offline / "logs").glob("debug*.log"))


def test_what_seeds_have_in_common_is_evaluated_once(run: tuple[Path, str], cache: Path, tmp_path: Path) -> None:
    folder, out = run
    assert "evaluate: before any attempt, kept at" in out
    again = _train(tmp_path / "other", cache, "logger=none", "seed=1", *RUN)
    assert "evaluate: before any attempt, from" in again
    zero_shots = [[row for row in _rows(each) if row["phase"] == "zero_shot"] for each in (folder, tmp_path / "other")]
    assert zero_shots[0] == zero_shots[1] != []
    results = [json.loads((each / "result.json").read_text()) for each in (folder, tmp_path / "other")]
    assert results[0]["zero_shot"] == results[1]["zero_shot"]
    assert _rows(folder) != _rows(tmp_path / "other"), "the seeds learn alike"


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


def test_a_finished_run_is_not_repeated(run: tuple[Path, str], cache: Path) -> None:
    folder, _ = run
    before = (folder / "result.json").stat().st_mtime_ns
    out = _train(folder, cache, "logger=none", *RUN)
    assert "finished already" in out
    assert (folder / "result.json").stat().st_mtime_ns == before


def test_same_seed_same_attempts_and_a_killed_run_continues(tmp_path: Path, cache: Path) -> None:
    overrides = ("logger=none", "task=normal", "seed=1", "finetune.attempts=8", "finetune.episode_attempts=2")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    _train(whole, cache, *overrides, "robot.video=true")  # which changes nothing
    assert (whole / "video.mp4").stat().st_size > 10_000
    process = subprocess.Popen(
        _command(killed, cache, *overrides), cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _wait(process, lambda: sum(row["phase"] == "finetune" for row in _rows(killed)) >= 5)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "result.json").exists()
    _train(killed, cache, *overrides)
    assert _rows(killed) == _rows(whole)
    weights = [torch.load(f / "checkpoints" / "affordance.ckpt", weights_only=True)["state_dict"] for f in (whole, killed)]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert json.loads((killed / "result.json").read_text())["evals"] == json.loads((whole / "result.json").read_text())["evals"]


def _evaluated(folder: Path) -> int:
    """Attempts of evaluations after the first."""
    return sum(row["phase"] == "eval" for row in _rows(folder))


def test_kill_ends_a_run_promptly_while_it_is_evaluated_too(tmp_path: Path, cache: Path) -> None:
    folder = tmp_path / "run"
    overrides = ("logger=none", "task=none", "transfer=none", "finetune.attempts=9", "evaluate.at=[0,1]", "evaluate.runs=8")
    process = subprocess.Popen(_command(folder, cache, *overrides), cwd=tmp_path, stderr=subprocess.DEVNULL)
    try:
        _wait(process, lambda: _evaluated(folder) > 0)
        evaluated = _evaluated(folder)
        process.send_signal(signal.SIGTERM)
        # How many seconds depends on what else the machine does: what counts is that only the present attempt is finished.
        assert process.wait(timeout=60) != 0
        assert _evaluated(folder) <= evaluated + 2 < 8 * (2 + 2)
    finally:
        process.kill()


def test_one_vision_model_serves_both_primitives_however_they_learn(config: Callable) -> None:
    def kept(*overrides: str) -> Path:
        return vision_path(config("task=edge", *overrides))

    assert kept("primitive=grasp") == kept("primitive=suction") == kept("primitive.lr=0.1", "finetune.head_lr=0.2")
    others = {kept(), kept("pretrain.lr=0.1"), kept("model.width=4"), kept("task=corner"), kept("labels=vision")}
    assert len(others) == 5


def test_a_vision_model_that_diverged_is_not_kept(cache: Path, tmp_path: Path) -> None:
    cfg = composed([*TINY, "model.width=4", f"paths.cache={cache}", "task=foreground", "pretrain.lr=1e30"])
    with pytest.raises(ConfigError, match=r"the vision model has diverged .*: lower pretrain\.lr"):
        vision_model(cfg, collected(cfg), partial(build.trainer, cfg, tmp_path, None))
    assert not vision_path(cfg).exists()


def test_a_task_that_labels_nothing_held_out_is_refused() -> None:
    color, height, valid = np.zeros((2, 8, 8, 3), np.uint8), np.zeros((2, 8, 8), np.float32), np.ones((2, 8, 8), bool)
    seen = {"color": color, "height": height, "valid": valid}
    bins = {**seen, **{f"clean_{name}": values for name, values in seen.items()}, "body": np.full((2, 8, 8), -1)}
    scenes = Collection(bins, Heightmap(color[0], height[0], valid[0]))
    with pytest.raises(ConfigError, match=r"labels nothing in 2 held-out scenes: raise pretrain\.test_scenes"):
        held_out_labels(composed(["task=foreground", "transfer=full"]), scenes)


def test_time_before_an_interruption_counts(tmp_path: Path) -> None:
    progress = Progress.load(tmp_path / "progress.json")

    def cut_short() -> None:
        with progress.timed("finetune"):
            time.sleep(0.2)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_short()
    assert Progress.load(tmp_path / "progress.json").seconds["finetune"] >= 0.2


def test_seconds_of_a_stage_within_another_are_not_counted_twice(tmp_path: Path) -> None:
    progress = Progress.load(tmp_path / "progress.json")
    with progress.timed("finetune"):
        for _ in range(2):
            with progress.timed("evaluate"):
                time.sleep(0.15)
        time.sleep(0.1)
    assert 0.3 <= progress.seconds["evaluate"] < 0.5
    assert 0.1 <= progress.seconds["finetune"] < 0.3


def test_a_vision_model_that_does_not_fit_is_refused_before_any_work(run: tuple[Path, str], tmp_path: Path) -> None:
    checkpoints = run[0] / "checkpoints"
    foreign = tmp_path / "foreign.ckpt"
    foreign.write_text("no checkpoint")
    for file, task, words in (
        (checkpoints / "vision.ckpt", "foreground", "backbone.0.weight is [4, 4, 3, 3] there and [8, 4, 3, 3] here"),
        (checkpoints / "vision.ckpt", "edge", "learned foreground, not edge: type task=foreground"),
        (checkpoints / "model.safetensors", "edge", "is a fine-tuned model: give the same run's checkpoints/vision.ckpt"),
        (foreign, "edge", "cannot be read"),
    ):
        command = _command(tmp_path / "run", tmp_path / "cache", "model.width=8", f"task={task}", f"task.weights={file}")
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
        assert done.returncode == 1
        assert words in done.stderr
        assert not (tmp_path / "cache").exists()


def test_folded_batchnorm_does_not_learn_from_batches(config: Callable, tmp_path: Path) -> None:
    state = NanoDet(depth="none").state_dict()
    folded = {key: torch.zeros_like(value) if key.endswith("epsilon") else value for key, value in state.items()}
    save_file(folded, tmp_path / "coco.safetensors")
    coco = ("model=nanodet_g", "task=coco", "transfer=full", f"task.weights={tmp_path / 'coco.safetensors'}")
    check_weights(config(*coco))
    with pytest.raises(TransferError, match=r"leave finetune\.batchnorm=frozen"):
        check_weights(config(*coco, "finetune.batchnorm=batch"))


def test_what_acts_is_what_is_kept(run: tuple[Path, str]) -> None:
    """The average of the parameters, which is not the last of them."""
    kept = load_file(run[0] / "checkpoints" / "model.safetensors")
    state = torch.load(run[0] / "checkpoints" / "affordance.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(value, state[f"average.module.{name}"]) for name, value in kept.items())
    assert any(not torch.equal(value, state[f"network.{name}"]) for name, value in kept.items())


def test_what_is_copied_starts_less_sure_and_what_is_new_has_statistics(
    run: tuple[Path, str], cache: Path, tmp_path: Path
) -> None:
    """The collection and the vision model are those of the run, from its cache."""

    def transferred(transfer: str) -> tuple[AffordanceModule, dict, DictConfig]:
        typed = (*TINY, "model.width=4", *RUN, "logger=none", f"paths.cache={cache}", f"transfer={transfer}")
        cfg = composed(typed)
        collection = collected(cfg)
        vision = vision_model(cfg, collection, partial(build.trainer, cfg, tmp_path, None))
        return affordance_model(cfg, collection, vision)[0], vision, cfg

    module, vision, cfg = transferred("full")
    seeing = build.network(cfg, 0)
    seeing.load_state_dict(vision["network"])
    x = torch.randn(1, 4, 144, 144, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert torch.allclose(module.network.eval()(x), seeing.eval()(x) / 4, atol=1e-5)
    module, _, _ = transferred("backbone")
    fresh = [layer for name, layer in batchnorms(module.network).items() if name.startswith("head.")]
    assert fresh
    assert all(layer.running_mean.abs().max() > 0 for layer in fresh)


def test_priorities_follow_predictions(run: tuple[Path, str]) -> None:
    checkpoint = torch.load(run[0] / "checkpoints" / "last.ckpt", weights_only=True)
    state = checkpoint["InteractiveDataModule"]
    assert state["attempts"] == len(state["replay"]["label"]) == 6
    assert len(set(state["replay"]["priority"])) > 3


def test_a_run_does_not_continue_another(run: tuple[Path, str], cache: Path) -> None:
    command = _command(run[0], cache, "logger=none", *RUN, "seed=5")
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=run[0].parent)
    assert done.returncode == 1
    assert "holds a run of another configuration" in done.stderr
    assert done.stderr.strip().count("\n") == 0


def test_the_baseline_and_a_fixed_transfer(tmp_path: Path, cache: Path) -> None:
    _train(tmp_path / "none", cache, "logger=tensorboard", "task=none", "transfer=none", "finetune.attempts=2")
    assert not json.loads((tmp_path / "none" / "transfer.json").read_text())["copied"]
    assert not (tmp_path / "none" / "checkpoints" / "vision.ckpt").exists()
    assert list((tmp_path / "none").rglob("events.out.tfevents.*"))
    _train(tmp_path / "fixed", cache, "logger=csv", "task=normal", "transfer=fixed")
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
    _train(folder, cache, *COCO, f"task.weights={file}", "transfer=fixed")
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
    _train(tmp_path / "coco", cache, "logger=none", "model=nanodet_g", "task=coco", "transfer=full", "primitive=suction", *few)
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
    _train(tmp_path / "imagenet", cache, *few, *resnet)
    report = json.loads((tmp_path / "imagenet" / "transfer.json").read_text())
    assert report["copied"]["backbone.body.conv1.0.weight"][1] == 4
    assert {key.split(".")[1] for key in report["left_at_initialisation"] if key.startswith("backbone")} == {"fpn"}


def test_the_rpn_learns_to_see_and_to_act(tmp_path: Path, cache: Path) -> None:
    rpn = ("model=rpn_r50_fpn", "model.backbone=resnet18", "task=foreground", "primitive=grasp", "primitive.angles=4")
    few = ("finetune.attempts=1", "evaluate.attempts.seen=1", "evaluate.attempts.unseen=1")
    _train(tmp_path / "rpn", cache, "logger=none", *rpn, *few)
    report = json.loads((tmp_path / "rpn" / "transfer.json").read_text())
    assert not report["left_at_initialisation"]
    assert (tmp_path / "rpn" / "result.json").exists()


def test_heatmaps_of_several_models_side_by_side(run: tuple[Path, str], cache: Path, tmp_path: Path) -> None:
    draw = [sys.executable, str(TRAIN.with_name("heatmaps.py")), "--out", str(tmp_path / "figure")]
    tiny = [*TINY, "model.width=4", "primitive=grasp", f"paths.cache={cache}"]
    tasks = ["--tasks", "none,imagenet,foreground", "--run", str(run[0])]
    done = subprocess.run([*draw, *tiny, *tasks], capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "figure" / "heatmaps.png").stat().st_size > 10_000
    assert "left out: imagenet: task=imagenet has no weights for model=fcn7" in done.stdout
    wider = [*tiny, "model.width=8"]
    done = subprocess.run([*draw, *tasks, *wider], capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 1
    assert "does not fit model=fcn7" in done.stderr


def test_a_report_reads_what_a_run_leaves(run: tuple[Path, str], tmp_path: Path) -> None:
    shutil.copytree(run[0], tmp_path / "runs" / "seed0", ignore=shutil.ignore_patterns("checkpoints", "wandb"))
    command = [sys.executable, str(TRAIN.with_name("report.py")), str(tmp_path / "runs")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    with (tmp_path / "runs" / "table.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["config_hash"]]
    assert [(row["task"], row["transfer"], row["after_seen_attempts"]) for row in rows] == [("foreground", "full", "2")]
    assert not any(words in done.stdout for words in ("Left out", "cannot be read", "unknown"))
    assert len(list((tmp_path / "runs" / "figures").glob("*.png"))) == 5  # there is nothing to compare with


def _sweep(folder: Path, cache: Path, *overrides: str) -> list[str]:
    few = ("logger=none", "finetune.attempts=0", f"paths.cache={cache}", f"hydra.sweep.dir={folder}")
    return [sys.executable, str(TRAIN), "-m", *TINY, *few, *_width(overrides), *overrides]


def _swept(folder: Path, cache: Path, *overrides: str, **environment: str) -> subprocess.CompletedProcess:
    command, known = _sweep(folder, cache, *overrides), os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, timeout=500, cwd=folder.parent, env=known)


def test_a_sweep_skips_conditions_that_make_no_sense_and_links_runs(tmp_path: Path, cache: Path) -> None:
    conditions = ("task=none,normal", "transfer=none,fixed")
    done = _swept(tmp_path / "sweep", cache, *conditions)
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(list(tmp_path.glob("sweep/**/result.json"))) == 2
    assert "2 combinations were skipped" in done.stdout.splitlines()[-3]
    done = _swept(tmp_path / "other", cache, *conditions, "conditions=[suction/normal/fixed]")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "were skipped" not in done.stdout
    linked = list(tmp_path.glob("other/**/result.json"))
    (original,) = tmp_path.glob("sweep/**/normal-fixed/**/result.json")
    assert [path.samefile(original) for path in linked] == [True]
    assert json.loads(linked[0].read_text())["choices"]["task"] == "normal"
    assert (linked[0].parent / "figures" / "heatmaps.png").exists()

    # Of another version of the code it is named, and neither linked nor run again.
    result = json.loads(original.read_text())
    result["versions"]["code"] = "of yesterday"
    original.write_text(json.dumps(result))
    done = _swept(tmp_path / "sweep", cache, *conditions, "conditions=[suction/normal/fixed]")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "1 runs are of another version of the code" in done.stdout
    assert json.loads(original.read_text()) == result


def test_one_job_that_fails_does_not_end_the_others(tmp_path: Path, cache: Path) -> None:
    conditions = (
        "task=none,imagenet",
        "transfer=none,backbone",
        "model=rpn_r50_fpn",
        "model.backbone=resnet18",
        "evaluate.runs=0,1",
    )
    nowhere = {"TORCH_HOME": str(tmp_path / "torch"), "https_proxy": "http://127.0.0.1:9"}  # on any machine
    done = _swept(tmp_path / "sweep", cache, *conditions, **nowhere)
    assert done.returncode == 1
    assert len(list(tmp_path.glob("sweep/**/result.json"))) == 1, done.stdout[-3000:]
    assert "2 jobs FAILED" in done.stdout
    assert "evaluate.runs=0: it must be at least 1" in done.stdout
    assert "1 jobs were skipped, since their weights are not here" in done.stdout
    assert "IMAGENET1K_V1 cannot be downloaded here" in done.stdout


def test_a_sweep_that_was_killed_goes_on(tmp_path: Path, cache: Path) -> None:
    """Four conditions, two at once; killed when the first is done. Nothing that was finished is run again."""
    overrides = ("task=none", "transfer=none", "seed=0,1,2,3", "finetune.attempts=4", "hydra.launcher.n_jobs=2")
    sweep = tmp_path / "sweep"
    process = subprocess.Popen(_sweep(sweep, cache, *overrides), cwd=tmp_path, start_new_session=True)
    try:
        _wait(process, lambda: any(sweep.rglob("result.json")))
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    done = list(sweep.rglob("result.json"))
    assert len(done) < 4
    before = {path: path.stat().st_mtime_ns for path in done}
    again = _swept(sweep, cache, *overrides)
    assert again.returncode == 0, again.stderr[-3000:]
    assert len(list(sweep.rglob("result.json"))) == 4
    assert {path: path.stat().st_mtime_ns for path in done} == before


def test_submitit_runs_the_jobs_of_a_sweep(tmp_path: Path, cache: Path) -> None:
    """Its local form, which is what SLURM's differs from in who starts the processes."""
    sweep = tmp_path / "sweep"
    overrides = ("task=none", "transfer=none", "seed=0,1", "finetune.attempts=1", "hydra/launcher=submitit_local")
    done = _swept(sweep, cache, *overrides)
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(list(sweep.rglob("result.json"))) == 2


def test_ctrl_c_ends_a_sweep_promptly(tmp_path: Path, cache: Path) -> None:
    overrides = ("task=none", "transfer=none", "seed=0,1,2,3", "finetune.attempts=400", "hydra.launcher.n_jobs=2")
    sweep = tmp_path / "sweep"
    # Whoever runs the tests in the background ignores SIGINT, and so would the sweep.
    process = subprocess.Popen(
        ["env", "--default-signal=INT", *_sweep(sweep, cache, *overrides)], cwd=tmp_path, start_new_session=True
    )
    try:
        _wait(process, lambda: len(list(sweep.rglob("attempts.csv"))) == 2)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(timeout=60) != 0  # of some thousand seconds that are left
        rows = [path.stat().st_size for path in sweep.rglob("attempts.csv")]
        time.sleep(3)
        assert [path.stat().st_size for path in sweep.rglob("attempts.csv")] == rows  # nobody goes on working
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
