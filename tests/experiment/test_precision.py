"""precision=auto takes what is faster on this processor."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from time import process_time

import pytest

from see2act.errors import ConfigError
from see2act.experiment import precision
from see2act.experiment.preflight import check_command


def _busy(seconds: dict[str, float], asked: list[str]) -> Callable[[str], Callable[[], None]]:
    def work(precision: str) -> Callable[[], None]:
        def turn() -> None:
            asked.append(precision)
            until = process_time() + seconds[precision]
            while process_time() < until:
                pass

        return turn

    return work


@pytest.fixture
def able(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "_cpuinfo", lambda: "model name : Some CPU (R) 9\nflags : fpu avx512f avx512_bf16")


@pytest.mark.parametrize(("fp32", "bf16", "fastest"), [(0.02, 0.005, "bf16"), (0.005, 0.02, "fp32"), (0.0200, 0.0197, "fp32")])
def test_bf16_is_taken_only_where_it_is_clearly_faster(able: None, fp32: float, bf16: float, fastest: str) -> None:
    found = precision.compared(_busy({"fp32": fp32, "bf16": bf16}, []))
    assert found["fastest"] == fastest
    assert found["fp32"] == pytest.approx(fp32, rel=0.5)


def test_it_is_measured_once_and_said(
    able: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(precision, "_attempt_s_work", _busy({"fp32": 0.02, "bf16": 0.005}, asked))
    with caplog.at_level(logging.INFO, "see2act"):
        assert precision.fastest_precision(str(tmp_path)) == "bf16"
    assert "in fp32 and" in caplog.text
    assert "so bf16; kept in" in caplog.text
    times = len(asked)
    assert precision.fastest_precision(str(tmp_path)) == "bf16"
    assert len(asked) == times
    (kept,) = tmp_path.rglob("*.json")
    kept.write_text(json.dumps(json.loads(kept.read_text()) | {"fastest": "fp32"}))
    assert precision.fastest_precision(str(tmp_path)) == "fp32"


def test_what_cannot_be_faster_is_not_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "_cpuinfo", lambda: "flags : fpu avx2")
    monkeypatch.setattr(precision, "compared", lambda work: pytest.fail("measured"))
    assert precision.fastest_precision(str(tmp_path)) == "fp32"
    assert precision.fastest_precision(str(tmp_path), "gpu") == "bf16"
    assert not list(tmp_path.iterdir())


def test_a_command_that_is_refused_measures_nothing(able: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(precision, "compared", lambda work: pytest.fail("measured"))
    with pytest.raises(ConfigError, match=r"finetune\.attempts=-1"):
        check_command(["finetune.attempts=-1", f"paths.cache={tmp_path}"])


def test_the_work_that_is_timed_is_an_attempt_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "REPEATS", 1)
    seconds = precision.compared(precision._attempt_s_work)
    assert min(seconds["fp32"], seconds["bf16"]) > 0.05  # 70 GFLOP
    assert seconds["fastest"] in ("fp32", "bf16")
