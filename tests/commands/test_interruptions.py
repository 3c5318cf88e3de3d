"""Runs and sweeps that are killed or interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import torch

from tests.jobs import command_of, rows_of, sweep_of, swept, train, wait

pytestmark = pytest.mark.slow


def test_same_seed_same_attempts_and_a_killed_run_continues(tmp_path: Path, cache: Path) -> None:
    overrides = ("logger=none", "task=normal", "seed=1", "finetune.attempts=8", "finetune.episode_attempts=2")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    train(whole, cache, *overrides)
    process = subprocess.Popen(
        command_of(killed, cache, *overrides), cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    wait(process, lambda: sum(row["phase"] == "finetune" for row in rows_of(killed)) >= 5)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "result.json").exists()
    train(killed, cache, *overrides)
    assert rows_of(killed) == rows_of(whole)
    weights = [torch.load(f / "checkpoints" / "affordance.ckpt", weights_only=True)["state_dict"] for f in (whole, killed)]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert json.loads((killed / "result.json").read_text())["evals"] == json.loads((whole / "result.json").read_text())["evals"]


def _evaluated(folder: Path) -> int:
    """Attempts of evaluations after the first."""
    return sum(row["phase"] == "eval" for row in rows_of(folder))


def test_kill_ends_a_run_promptly_while_it_is_evaluated_too(tmp_path: Path, cache: Path) -> None:
    folder = tmp_path / "run"
    overrides = ("logger=none", "task=none", "transfer=none", "finetune.attempts=9", "evaluate.at=[0,1]", "evaluate.runs=8")
    process = subprocess.Popen(command_of(folder, cache, *overrides), cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        wait(process, lambda: _evaluated(folder) > 0)
        evaluated = _evaluated(folder)
        process.send_signal(signal.SIGTERM)
        # How many seconds depends on what else the machine does: what counts is that the other test runs are not made.
        assert process.wait(timeout=60) != 0
        assert _evaluated(folder) <= evaluated + 2 < 8 * (2 + 2)
        assert process.stderr is not None
        told = process.stderr.read()
        assert "see2act: interrupted: type the same command again to go on" in told
        assert "Traceback" not in told
    finally:
        process.kill()


def test_a_sweep_that_was_killed_goes_on(tmp_path: Path, cache: Path) -> None:
    """Four conditions, two at once; killed when the first is done, workers left alone. Nothing finished is run again."""
    overrides = ("task=none", "transfer=none", "seed=0,1,2,3", "finetune.attempts=4", "hydra.launcher.n_jobs=2")
    sweep = tmp_path / "sweep"
    process = subprocess.Popen(sweep_of(sweep, cache, *overrides), cwd=tmp_path, start_new_session=True)
    try:
        wait(process, lambda: any(sweep.rglob("result.json")))
    finally:
        process.kill()
        process.wait()
    done = list(sweep.rglob("result.json"))
    assert len(done) < 4
    before = {path: path.stat().st_mtime_ns for path in done}
    again = swept(sweep, cache, *overrides)
    assert again.returncode == 0, again.stderr[-3000:]
    assert len(list(sweep.rglob("result.json"))) == 4
    assert {path: path.stat().st_mtime_ns for path in done} == before


def test_a_worker_of_a_sweep_that_was_killed_is_told_in_one_line(tmp_path: Path, cache: Path) -> None:
    """As the system does when memory runs out."""
    overrides = ("task=none", "transfer=none", "seed=0,1", "finetune.attempts=400", "hydra.launcher.n_jobs=2")
    sweep = tmp_path / "sweep"
    process = subprocess.Popen(
        sweep_of(sweep, cache, *overrides), cwd=tmp_path, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    try:
        wait(process, lambda: len(list(sweep.rglob("attempts.csv"))) == 2)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        worker = next(child for child in children if b"LokyProcess" in Path(f"/proc/{child}/cmdline").read_bytes())
        os.kill(int(worker), signal.SIGKILL)
        told = process.communicate(timeout=120)[1]
        assert process.returncode == 1
        assert "see2act: something ended a worker process" in told
        assert "Traceback" not in told
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def test_ctrl_c_ends_a_sweep_promptly(tmp_path: Path, cache: Path) -> None:
    overrides = ("task=none", "transfer=none", "seed=0,1,2,3", "finetune.attempts=400", "hydra.launcher.n_jobs=2")
    sweep = tmp_path / "sweep"
    # Whoever runs the tests in the background ignores SIGINT, and so would the sweep.
    process = subprocess.Popen(
        ["env", "--default-signal=INT", *sweep_of(sweep, cache, *overrides)], cwd=tmp_path, start_new_session=True
    )
    try:
        wait(process, lambda: len(list(sweep.rglob("attempts.csv"))) == 2)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(timeout=60) != 0  # of some thousand seconds that are left
        rows = [path.stat().st_size for path in sweep.rglob("attempts.csv")]
        time.sleep(3)
        assert [path.stat().st_size for path in sweep.rglob("attempts.csv")] == rows  # nobody goes on working
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
