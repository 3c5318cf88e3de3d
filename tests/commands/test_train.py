"""One run: what it leaves, and what others read of it."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from functools import partial
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig
from safetensors.torch import load_file

from see2act.errors import TransferError
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.pretrain import vision_model
from see2act.experiment.stages.transfer import affordance_model, check_weights
from see2act.modules.affordance import AffordanceModule
from see2act.modules.batchnorm import batchnorms
from tests.jobs import TINY, TRAIN, command_of, rows_of, train

RUN = ("task=foreground", "primitive=grasp", "finetune.attempts=6", "finetune.episode_attempts=3")
PICTURES = {"learning_curve.png", "diagnosis.png", "labels.png", "vision.png", "heatmaps.png", "picks.png"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("runs") / "first"
    out = train(folder, cache, "logger=wandb", *RUN, HOME="/proc/nobody")  # as a service's user, who has none
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
    rows = rows_of(folder)
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
    for name in (
        "vision/loss",
        "affordance/success",
        "affordance/entropy",
        "affordance/temperature",
        "replay/age",
        "evaluate/unseen",
    ):
        assert name in found
    assert all(f"figures/{name.removesuffix('.png')}" in found for name in PICTURES)
    assert str(result["eval"]["unseen"]["rate"]) in found
    (table,) = (offline / "files" / "media" / "table").glob("attempts_*.table.json")
    assert len(json.loads(table.read_text())["data"]) == len(rows_of(folder))
    assert "lookup" not in "".join(log.read_text() for log in (offline / "logs").glob("debug*.log"))


def test_the_file_for_wandb_holds_the_whole_run(run: tuple[Path, str]) -> None:
    """Record by record, as ``wandb sync`` sends it: whose run it is, configuration, history, figures, table, and its end."""
    folder, _ = run
    (offline,) = (folder / "wandb").glob("offline-run-*")
    wandb = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", str(offline)]
    read = subprocess.run(wandb, capture_output=True, text=True, check=True, timeout=60)
    records: dict[str, list[dict]] = defaultdict(list)
    for line in read.stdout.splitlines():
        record = json.loads(line)
        records[record["type"]].append(record.get(record["type"]))
    (known,) = records["run"]
    assert (known["project"], known["run_group"]) == ("see2act", "sweep")
    assert known["display_name"] == "grasp-foreground-full-seed-0"
    config = {key: value for update in records["config"] for key, value in update["update"].items()}
    assert (config["seed"], config["task"]["name"], config["finetune"]["attempts"]) == (0, "foreground", 6)
    assert [step["step"]["num"] for step in records["history"]] == list(range(len(records["history"])))
    history = [step["item"] for step in records["history"]]
    result = json.loads((folder / "result.json").read_text())
    learned = [step["affordance/success"] for step in history if "affordance/success" in step]
    assert len(learned) == 6
    assert sum(learned) == sum(int(row["success"]) for row in rows_of(folder) if row["phase"] == "finetune")
    evaluated = [(step["attempts"], step["evaluate/unseen"]) for step in history if "evaluate/unseen" in step]
    assert evaluated == [(each["step"], each["unseen"]["rate"]) for each in result["evals"]]
    figures = [file for step in history for key, files in step.items() if key.endswith(".filenames") for file in files]
    assert {Path(file).name.rsplit("_", 2)[0] for file in figures} == {path.stem for path in (folder / "figures").iterdir()}
    assert all((offline / "files" / file).stat().st_size > 1000 for file in figures)
    (table,) = [step for step in history if step.get("attempts._type") == "table-file"]
    assert table["attempts.nrows"] == len(rows_of(folder))
    assert (offline / "files" / table["attempts.path"]).exists()
    assert [end["exit_code"] for end in records["exit"]] == [0]


def test_what_seeds_have_in_common_is_evaluated_once(run: tuple[Path, str], cache: Path, tmp_path: Path) -> None:
    folder, out = run
    assert "evaluate: before any attempt, kept at" in out
    again = train(tmp_path / "other", cache, "logger=none", "seed=1", *RUN)
    assert "evaluate: before any attempt, from" in again
    zero_shots = [[row for row in rows_of(each) if row["phase"] == "zero_shot"] for each in (folder, tmp_path / "other")]
    assert zero_shots[0] == zero_shots[1] != []
    results = [json.loads((each / "result.json").read_text()) for each in (folder, tmp_path / "other")]
    assert results[0]["zero_shot"] == results[1]["zero_shot"]
    assert rows_of(folder) != rows_of(tmp_path / "other"), "the seeds learn alike"


def test_a_finished_run_is_not_repeated(run: tuple[Path, str], cache: Path) -> None:
    folder, _ = run
    before = (folder / "result.json").stat().st_mtime_ns
    out = train(folder, cache, "logger=none", *RUN)
    assert "finished already" in out
    assert (folder / "result.json").stat().st_mtime_ns == before


def test_a_run_does_not_continue_another(run: tuple[Path, str], cache: Path) -> None:
    command = command_of(run[0], cache, "logger=none", *RUN, "seed=5")
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=run[0].parent)
    assert done.returncode == 1
    assert "holds a run of another configuration" in done.stderr
    assert done.stderr.strip().count("\n") == 0


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
        typed = ("model.width=8", f"task={task}", f"task.weights={file}")
        with pytest.raises(TransferError, match=re.escape(words)):
            check_weights(composed([*TINY, *typed]))
    command = command_of(tmp_path / "run", tmp_path / "cache", *typed)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 1
    assert words in done.stderr
    assert not (tmp_path / "cache").exists()


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
    assert len(list((tmp_path / "runs" / "figures").glob("*.png"))) == 6  # there is nothing to compare with
