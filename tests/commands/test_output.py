"""What commands do with standard output that nobody reads, and what they do not write."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
from pathlib import Path
from see2act.commands import user_errors_end_the_program

with user_errors_end_the_program():
    for i in range(100_000):
        print("line", i)
    print("to the end", flush=True)
Path(sys.argv[1]).write_text("done")
"""


def test_work_goes_on_when_its_output_is_cut_by_head(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "file")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == "line 0\n"
    process.stdout.close()
    assert process.wait(60) == 0
    assert process.stderr.read() == ""
    assert (tmp_path / "file").read_text() == "done"


def test_a_login_node_of_a_cluster_is_no_reason_for_a_warning(tmp_path: Path) -> None:
    """Lightning warns of an ``srun`` that is there and not used."""
    (tmp_path / "srun").write_text("#!/bin/sh\n")
    (tmp_path / "srun").chmod(0o755)
    program = "from see2act.experiment.checks import check_run; from see2act.experiment.config import composed; "
    program += "check_run(composed(['precision=fp32']))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0
    assert done.stderr == ""
