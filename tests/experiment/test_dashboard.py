"""Dashboards that cannot be had."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
from pathlib import Path
from wandb.sdk.lib.service import service_process
from see2act.commands import user_errors_end_the_program
from see2act.experiment.config import composed
from see2act.experiment.dashboard import Dashboard

service_process.get_core_path = lambda: "/bin/false"
with user_errors_end_the_program():
    Dashboard.of(composed([]), Path(sys.argv[1]), "a run")
"""


def test_a_service_of_wandb_that_cannot_start_is_said(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)  # it used to wait for ever
    assert done.returncode == 1
    assert "see2act: wandb cannot start (wandb-core exited with code 1): mend that, or add logger=tensorboard" in done.stderr
