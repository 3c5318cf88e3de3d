"""Whole jobs as a user types them, tiny ones: everything is real but the numbers."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

TRAIN = Path(__file__).parents[1] / "train.py"
TINY = (
    *(
        "threads=1",
        "precision=fp32",
        "collect.interactions=10",
        "pretrain.epochs=1",
        "pretrain.batch_size=4",
        "pretrain.test_scenes=2",
        "finetune.updates=2",
        "finetune.batch_size=4",
    ),
    *("evaluate.attempts.seen=2", "evaluate.attempts.unseen=2", "figures.scenes=1"),
)


def command_of(folder: Path, cache: Path, *overrides: str) -> list[str]:
    where = (f"hydra.run.dir={folder}", f"paths.cache={cache}")
    return [sys.executable, str(TRAIN), *TINY, *_width(overrides), *where, *overrides]


def _width(overrides: tuple[str, ...]) -> tuple[str, ...]:
    return () if {"model=rpn_r50_fpn", "model=nanodet_g", "model=timm_fpn"} & {*overrides} else ("model.width=4",)


def train(folder: Path, cache: Path, *overrides: str, **environment: str) -> str:
    command, known = command_of(folder, cache, *overrides), os.environ | environment
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, cwd=folder.parent, env=known)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "warning" not in done.stderr.lower(), done.stderr[-3000:]
    return done.stdout


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Rows of attempts.csv, times aside."""
    if not (folder / "attempts.csv").exists():
        return []
    with (folder / "attempts.csv").open() as file:
        return [{k: v for k, v in row.items() if not k.startswith("t_")} for row in csv.DictReader(file)]


def wait(process: subprocess.Popen, until: Callable[[], bool]) -> None:
    """Until something has come about in a process that goes on."""
    deadline = time.monotonic() + 300
    while not until():
        assert process.poll() is None, "it ended too soon"
        assert time.monotonic() < deadline
        time.sleep(0.02)


def sweep_of(folder: Path, cache: Path, *overrides: str) -> list[str]:
    few = ("logger=none", "finetune.attempts=0", f"paths.cache={cache}", f"hydra.sweep.dir={folder}")
    return [sys.executable, str(TRAIN), "-m", *TINY, *few, *_width(overrides), *overrides]


def swept(folder: Path, cache: Path, *overrides: str, **environment: str) -> subprocess.CompletedProcess:
    command, known = sweep_of(folder, cache, *overrides), os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, timeout=500, cwd=folder.parent, env=known)
