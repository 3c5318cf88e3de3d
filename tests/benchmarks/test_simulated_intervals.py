"""What the simulation of intervals says."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import intervals


def test_a_t_interval_contains_the_mean_as_often_as_it_says_and_a_bootstrap_of_three_models_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = tmp_path / "rows.json"
    monkeypatch.setattr(sys, "argv", ["intervals", "--draws", "400", "--json", str(rows)])
    intervals.main()
    share = {(row["interval"], row["of"][:2].strip()): row["share"] for row in json.loads(rows.read_text())}
    for interval, models in (("t interval over seeds", "10"), ("t interval of the models' means", "3")):
        assert share[interval, models] == pytest.approx(0.95, abs=0.03)
    assert share["hierarchical bootstrap", "3"] < 0.85
    assert share["exact interval of the median", "10"] == pytest.approx(0.979, abs=0.02)
    assert share["called better or worse", "tw"] < 0.07
