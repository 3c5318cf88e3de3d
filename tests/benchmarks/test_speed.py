"""The measurements of time at tiny numbers: that they run, and that each is told when it misses its target."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import common, loop, stages, sweep

pytestmark = pytest.mark.slow
TINY = [
    "collect.interactions=12",
    "pretrain.epochs=1",
    "pretrain.batch_size=4",
    "pretrain.test_scenes=2",
    "model.width=4",
    "precision=fp32",
]


@pytest.fixture(autouse=True)
def _threads_are_left_as_they_were() -> None:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_a_row_says_whether_its_target_is_met() -> None:
    assert common.faster("a", 1.0, 3.0, 2.0) | {"name": "a"} == {
        **{"name": "a", "seconds": 1.0, "naive_seconds": 3.0, "ratio": 3.0, "target": ">= 2", "met": True}
    }
    assert common.faster("a", 2.0, 3.0, 2.0)["met"] is False
    assert common.overhead("a", 1.2, 1.0, 1.3)["met"] is True
    assert common.overhead("a", 1.4, 1.0, 1.3)["met"] is False
    assert common.overhead("a", 1.4, 1.0, None)["met"] is None
    assert common.limit("a", 0.4, 0.3)["met"] is False


def test_stages_give_what_the_plain_way_gives() -> None:
    """Each row compares results before it compares times, and raises where they differ."""
    names = [row["name"] for row in stages.observing(TINY, 1)]
    names += [row["name"] for row in stages.deciding(TINY, "fcn7", 1)]
    names += [row["name"] for row in stages.learning(TINY, "fcn7", "grasp", 1)]
    names += [row["name"] for row in stages.filling(TINY, 1)]
    assert len(names) == len(set(names)) == 7


def test_a_decision_that_differs_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    affordances = stages.AffordanceModule.affordances
    monkeypatch.setattr(stages.AffordanceModule, "affordances", lambda *args: -affordances(*args))
    with pytest.raises(RuntimeError, match="another pixel"):
        stages.deciding(TINY, "fcn7", 1)


def test_the_loop_attempts_what_its_stages_would(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEE2ACT_CACHE", str(tmp_path))
    monkeypatch.setattr(loop, "SOURCES", {"suction": "edge"})
    rows = {row["name"]: row for row in loop.rows(TINY, 1)}
    ours = rows["attempt of the loop, suction, against its stages alone"]
    assert sum(row["seconds"] for name, row in rows.items() if name.startswith("  ")) == pytest.approx(ours["naive_seconds"])
    assert rows["a seed of the benchmark, 14 runs, on two cores"]["seconds"] > 0


def test_a_sweep_that_does_not_end_is_no_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "JOBS", 1)
    with pytest.raises(RuntimeError, match=r"evaluate\.runs=0"):
        sweep.rows(["evaluate.runs=0"], 1)
