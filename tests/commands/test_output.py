"""What commands do with standard output that nobody reads."""

from __future__ import annotations

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
