"""Which jobs of a sweep SLURM's queue still lists."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from submitit import SlurmJob

from see2act.experiment.slurm import Queue, watch_queue


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file whose words are the numbers of the jobs in the queue, as ``squeue`` prints them."""
    listed = tmp_path / "queue"
    program = tmp_path / "squeue"
    program.write_text(f"#!/bin/sh\ncat {listed}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return listed


def test_a_job_that_has_left_the_queue_has_ended(queue: Path) -> None:
    queue.write_text("7_0\n7_2\n")
    jobs = Queue()
    for job in ("7_0", "7_1", "7_2"):
        jobs.register_job(job)
    assert [jobs.is_done(job, mode="force") for job in ("7_0", "7_1", "7_2")] == [False, True, False]
    queue.write_text("")
    time.sleep(0.01)  # submitit asks no more than once in a millisecond
    assert jobs.is_done("7_0", mode="force")
    jobs.wait_for_all()


def test_no_job_has_ended_while_the_queue_does_not_answer(queue: Path) -> None:
    jobs = Queue()
    jobs.register_job("7_0")
    assert not jobs.is_done("7_0", mode="force")


def test_a_job_that_was_killed_is_noticed_without_accounting(
    queue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue.write_text("")
    monkeypatch.setattr(SlurmJob, "watcher", SlurmJob.watcher)  # and back at the end
    watch_queue()
    job: SlurmJob = SlurmJob(tmp_path, "7_0")
    assert job.done(force_check=True)
