from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import agreement

TINY = ["collect.interactions=12", "pretrain.epochs=1", "pretrain.batch_size=4", "pretrain.test_scenes=2", "model.width=4"]


def test_a_difference_of_more_than_three_points_is_told() -> None:
    rows = [
        {"primitive": "suction", "successes": 90, "attempts": 100, "rate": 0.9},
        {"primitive": "suction", "successes": 88, "attempts": 100, "rate": 0.88},
        {"primitive": "suction", "successes": 80, "attempts": 100, "rate": 0.8},
        {"primitive": "grasp", "successes": 50, "attempts": 100, "rate": 0.5},
    ]
    assert [row["met"] for row in agreement.compared(rows)] == [None, True, False, None]
    assert [round(row["difference"], 2) for row in rows] == [0, -0.02, -0.1, 0]
    assert rows[2]["low"] < -0.1 < rows[2]["high"]


@pytest.mark.slow
def test_settings_are_measured_with_one_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEE2ACT_CACHE", str(tmp_path))
    threads = torch.get_num_threads()
    few = [*TINY, "evaluate.attempts.seen=2", "evaluate.attempts.unseen=2"]
    for setting in agreement.SETTINGS:
        assert agreement.measure(few, "suction", setting, 1)["attempts"] == 4
    assert len(list(tmp_path.glob("vision/*.ckpt"))) == 1
    torch.set_num_threads(threads)
