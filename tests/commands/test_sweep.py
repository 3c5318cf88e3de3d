"""Sweeps: which jobs run, which are skipped, and what one that fails does to the others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.jobs import swept

pytestmark = pytest.mark.slow


def test_a_sweep_skips_conditions_that_make_no_sense_and_links_runs(tmp_path: Path, cache: Path) -> None:
    conditions = ("task=none,normal", "transfer=none,fixed")
    done = swept(tmp_path / "sweep", cache, *conditions)
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(list(tmp_path.glob("sweep/**/result.json"))) == 2
    assert "2 combinations were skipped" in done.stdout.splitlines()[-3]
    done = swept(tmp_path / "other", cache, *conditions, "conditions=[suction/normal/fixed]")
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
    done = swept(tmp_path / "sweep", cache, *conditions, "conditions=[suction/normal/fixed]")
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
    done = swept(tmp_path / "sweep", cache, *conditions, **nowhere)
    assert done.returncode == 1
    assert len(list(tmp_path.glob("sweep/**/result.json"))) == 1, done.stdout[-3000:]
    assert "2 jobs FAILED" in done.stdout
    assert "evaluate.runs=0: it must be at least 1" in done.stdout
    assert "1 jobs were skipped, since their weights are not here" in done.stdout
    assert "IMAGENET1K_V1 cannot be downloaded here" in done.stdout


def test_submitit_runs_the_jobs_of_a_sweep(tmp_path: Path, cache: Path) -> None:
    """Its local form, which is what SLURM's differs from in who starts the processes."""
    sweep = tmp_path / "sweep"
    overrides = ("task=none", "transfer=none", "seed=0,1", "finetune.attempts=1", "hydra/launcher=submitit_local")
    done = swept(sweep, cache, *overrides)
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(list(sweep.rglob("result.json"))) == 2
