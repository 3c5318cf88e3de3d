from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.clusters import Promises, daemon, left_over, wait_until
from benchmarks.many_jobs import family, growth

ROOT = Path(__file__).parents[2]


def test_daemons_end_with_the_block_and_so_do_their_children(tmp_path: Path) -> None:
    mark = f"SEE2ACT_MARK={tmp_path}"
    environment = os.environ | {"SEE2ACT_MARK": str(tmp_path)}
    obedient, deaf = "sleep 300 & echo ready; wait", "trap '' TERM; sleep 300 & echo ready; wait"
    for number, program in enumerate((obedient, deaf)):
        log = tmp_path / f"{number}.log"
        with suppress(KeyboardInterrupt), daemon(["sh", "-c", program], log, environment, patience=1) as it:
            wait_until(lambda log=log: "ready" in log.read_text(), 30, "it has not begun")
            assert len(family(it.pid)) == len(left_over(mark)) == 2
            raise KeyboardInterrupt
        wait_until(lambda: not left_over(mark), 10, "something lives on")


def test_a_broken_promise_ends_the_program_with_status_1(capsys: pytest.CaptureFixture) -> None:
    promises = Promises()
    promises.check(True, "the sun rises", "in the east")
    with pytest.raises(SystemExit) as ended:
        promises.end()
    assert not ended.value.code
    promises.check(False, "the sun stays")
    with pytest.raises(SystemExit) as ended:
        promises.end()
    assert ended.value.code
    told = capsys.readouterr().out
    assert "ok     the sun rises: in the east" in told
    assert "BROKEN the sun stays" in told


@pytest.mark.parametrize(
    ("check", "words"),
    [
        ("slurm", "apt-get install slurm-wlm munge"),
        pytest.param("ray_nodes", "docs/scaling.md", marks=pytest.mark.skipif(bool(find_spec("ray")), reason="Ray is here")),
    ],
)
def test_what_is_missing_is_named_with_the_way_to_get_it(check: str, words: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", f"benchmarks.{check}"]
    nothing = os.environ | {"PATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=nothing, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_growth_is_measured_between_jobs_that_are_warm() -> None:
    steady = [(0, 100.0), (3, 900.0)] + [(job, 1000.0) for job in range(10, 200)]
    assert growth(steady) == 0
    leaking = [(job, memory + job * 0.5) for job, memory in steady]
    assert growth([*leaking, (200, 3.0)]) == pytest.approx(50, abs=2)  # of the last sample, half of the processes had ended
