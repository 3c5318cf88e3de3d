"""`see2act train`: one run, or with -m a sweep of runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from see2act.commands import user_errors_end_the_program
from see2act.errors import ConfigError, UserError
from see2act.experiment.config import one_line, register
from see2act.experiment.preflight import check_command, check_sweep
from see2act.experiment.single import run_checked
from see2act.experiment.sweep import Summary, run_job

FLAGS = (
    "-m",
    "--multirun",
    "--help",
    "-h",
    "--hydra-help",
    "--cfg",
    "-c",
    "--info",
    "-i",
    "--version",
    "--resolve",
    "--package",
    "-p",
    "--config-dir",
    "-cd",
    "--config-name",
    "-cn",
    "--config-path",
    "-cp",
)
"""With these Hydra does something other than one run and does its own checking."""
CONFUSED = (HydraException, OmegaConfBaseException, ValueError)
"""What it then says of a command line that makes no sense."""
LAUNCHERS = ("submitit", "ray")
"""Libraries whose errors say that a job was killed, or its machine."""


def main() -> None:
    """Run ``train.py`` with the process's arguments."""
    register()
    with user_errors_end_the_program():
        flags = {argument.split("=")[0] for argument in sys.argv[1:] if argument.startswith("-")}
        expected = CONFUSED if flags & {*FLAGS} - {"-m", "--multirun"} else (HydraException,)
        if flags and flags <= {"-m", "--multirun"}:
            check_sweep([argument for argument in sys.argv[1:] if not argument.startswith("-")])
        elif not flags & {*FLAGS}:
            check_command(sys.argv[1:])
        if flags:
            os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints a traceback of its own, as of a worker that was killed
        try:
            _hydra_main()
        except expected as error:
            raise ConfigError(one_line(error)) from None
        except Exception as error:
            if Summary.of_sweep:
                Summary.of_sweep.broken_off()
            if type(error).__module__.partition(".")[0] not in LAUNCHERS:
                raise
            why = " ".join(str(error).splitlines()[:2])
            raise UserError(f"a job was lost ({why}): type the same command again to go on") from error
    if Summary.failures:
        sys.exit(1)


@hydra.main(version_base="1.3", config_path="pkg://see2act.conf", config_name="train")
def _hydra_main(cfg: DictConfig) -> float | None:
    """A run, or a job of a sweep."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return run_job(cfg, folder, Path(HydraConfig.get().sweep.dir).absolute())
    with user_errors_end_the_program():
        return run_checked(cfg, folder)
