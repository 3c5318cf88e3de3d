"""What a sweep says of jobs that were killed, whichever launcher started them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hydra.core.utils import JobReturn
from omegaconf import OmegaConf
from submitit.core.utils import UncompletedJobError

from see2act.commands import train
from see2act.experiment.folder import alone_in
from see2act.experiment.sweep import Summary


@pytest.fixture
def summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Summary:
    """Of a sweep in ``tmp_path`` that has begun."""
    monkeypatch.setattr(Summary, "failures", 0)
    monkeypatch.setattr(Summary, "of_sweep", None)
    begun = Summary()
    begun.on_multirun_start(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
    jobs = {"done": ("run.json", "result.json"), "lost": ("run.json",), "impossible": ("skipped.txt",), "not named": ()}
    for name, files in jobs.items():
        for file in (*files, ".hydra/config.yaml"):
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).write_text("why")
    return begun


def test_a_sweep_names_the_runs_that_were_begun_and_not_finished(summary: Summary, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        summary.broken_off()
    assert "1 jobs were begun and are not finished" in caplog.text
    assert caplog.text.count("\n  lost\n") == 1
    assert Summary.failures == 1


def test_a_run_that_another_sweep_is_at_work_on_is_not_lost(
    summary: Summary, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    with alone_in(tmp_path / "lost"):
        summary.on_multirun_end(config)
    assert "not finished" not in caplog.text
    assert Summary.failures == 0
    summary.on_multirun_end(config)
    assert "\n  lost" in caplog.text
    assert Summary.failures == 1


def test_a_job_that_slurm_lost_is_told_in_one_line_after_the_summary(
    summary: Summary, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed() -> None:
        raise UncompletedJobError("Job 7_1 (task: 0) with path result.pkl\nhas not produced any output\nand so on")

    monkeypatch.setattr(train, "_hydra_main", killed)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "seed=0,1"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # and as it was at the end
    with caplog.at_level("INFO"), pytest.raises(SystemExit) as ended:
        train.main()
    assert "\n  lost\n" in caplog.text
    assert str(ended.value.code) == (
        "see2act: a job was lost (Job 7_1 (task: 0) with path result.pkl has not produced any output): "
        "type the same command again to go on"
    )


def test_a_mistake_of_this_code_is_not_taken_for_a_lost_job(summary: Summary, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong() -> None:
        raise TypeError("a bug")

    monkeypatch.setattr(train, "_hydra_main", wrong)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "seed=0,1"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(TypeError, match="a bug"):
        train.main()


def test_what_hydra_keeps_of_a_job_is_small(summary: Summary) -> None:
    """It keeps a return of each until the last has ended: a sweep of 200 jobs grew by a quarter of a megabyte with each."""
    kept = JobReturn(cfg=OmegaConf.create({"a": 1}), hydra_cfg=OmegaConf.create({"hydra": {}}))
    summary.on_job_end(OmegaConf.create(), job_return=kept)
    assert (kept.cfg, kept.hydra_cfg) == (None, None)
