"""The examples of docs/extending.md, as a stranger would run them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from see2act.experiment.config import composed
from see2act.experiment.identity import hash_of

HERE = Path(__file__).parents[1]
EXAMPLES = HERE / "docs" / "extending"
SEARCHED = f"hydra.searchpath=['file://{EXAMPLES}/conf']"  # quoted, since a path may contain spaces
TINY = (
    *("logger=none", "model.width=4", "collect.interactions=12", "collect.workers=1", "threads=1", "figures.scenes=1"),
    *("pretrain.epochs=1", "pretrain.batch_size=4", "pretrain.test_scenes=2", "finetune.attempts=3", "finetune.updates=1"),
    *("evaluate.attempts.seen=2", "evaluate.attempts.unseen=2"),
)


def _train(folder: Path, *overrides: str) -> dict:
    command = [sys.executable, "train.py", SEARCHED, f"hydra.run.dir={folder}", *TINY]
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES), "SEE2ACT_CACHE": str(folder.parent / "cache")}
    done = subprocess.run([*command, *overrides], cwd=HERE, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    result: dict = json.loads((folder / "result.json").read_text())
    return result


def test_a_task_a_network_and_a_robot_of_one_s_own(tmp_path: Path) -> None:
    result = _train(tmp_path / "run", "task=tall", "model=dilated", "robot=discs", "transfer=full")
    assert (result["choices"]["task"], result["choices"]["model"]) == ("tall", "dilated")
    assert 0 < result["vision"]["positive_share"] < 1
    assert result["eval"]["seen"]["attempts"] == 2


def test_the_other_choices_run_to_their_end(tmp_path: Path) -> None:
    other = ("transfer=backbone", "policy=argmax", "labels=vision", "evaluate.scenes=develop", "finetune.batchnorm=batch")
    result = _train(tmp_path / "run", "task=tall", "robot=discs", *other)
    assert (result["choices"]["transfer"], result["choices"]["labels"]) == ("backbone", "vision")
    assert result["eval_argmax"]["repeated"]
    again = _train(tmp_path / "run", "task=tall", "robot=discs", *other, "force=true")
    assert again["evals"] == result["evals"]
    (aside,) = (path for path in tmp_path.iterdir() if path.name.startswith("run."))
    assert json.loads((aside / "result.json").read_text()) == result


def test_objects_of_one_s_own(tmp_path: Path) -> None:
    result = _train(tmp_path / "run", "objects=cans", "task=none", "transfer=none", "finetune.attempts=0")
    assert result["choices"]["objects"] == "cans"


def test_an_experiment_of_one_s_own() -> None:
    cfg = composed([SEARCHED, "experiment=mine", "task=normal"])
    assert (cfg.name, cfg.collect.interactions, cfg.finetune.attempts) == ("mine", 1000, 150)


def test_every_example_is_shown() -> None:
    text = (HERE / "docs" / "extending.md").read_text()
    for path in [*EXAMPLES.glob("*.py"), *EXAMPLES.rglob("*.yaml")]:
        assert path.relative_to(EXAMPLES).as_posix() in text


def test_the_hash_knows_code_from_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "elsewhere.py").write_text("class Thing:\n    number = 1\n")
    node = {
        "group": [{"_target_": "elsewhere.Thing"}],
        "ours": {"_target_": "see2act.policy.Policy"},
        "torch": {"_target_": "torch.nn.ReLU"},
        "builtin": {"_target_": "builtins.dict"},
        "method": {"_target_": "elsewhere.Thing.make"},
    }
    before = hash_of(node)
    (tmp_path / "elsewhere.py").write_text("class Thing:\n    number = 1  # as before\n")
    assert hash_of(node) == before
    (tmp_path / "elsewhere.py").write_text("class Thing:\n    number = 2\n")
    assert hash_of(node) != before


def test_the_hash_does_not_know_where_a_class_of_ours_lies() -> None:
    here, moved, other = (
        {"policy": {"_target_": name}} for name in ("see2act.a.Policy", "see2act.b.c.Policy", "see2act.a.Rule")
    )
    assert hash_of(here) == hash_of(moved) != hash_of(other)
