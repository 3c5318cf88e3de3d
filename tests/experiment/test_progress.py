"""How long each stage took."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from see2act.experiment.progress import Progress


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
