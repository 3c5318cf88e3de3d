"""Refuse a command line that cannot run, before Hydra makes a folder for it."""

from __future__ import annotations

import copy
from pathlib import Path, PurePath
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from see2act.errors import ConfigError
from see2act.experiment.annotations import check_schema
from see2act.experiment.checks import check_run, validate
from see2act.experiment.config import Config, composed_as_typed, one_line
from see2act.experiment.folder import refuse_foreign
from see2act.files import writable


def check_command(overrides: list[str]) -> None:
    """Compose the configuration as Hydra will, and refuse what cannot run before a folder is made.

    Raises:
        ConfigError: With one line.
    """
    if experiment := next((o.split("=")[1] for o in overrides if o.lstrip("+").startswith("experiment=")), None):
        raise ConfigError(
            f"experiment={experiment} is a sweep: add -m, and primitive=, task=, transfer= and seed= if you want one run of it"
        )
    cfg = composed_as_typed(overrides, return_hydra_config=True)
    checked = copy.deepcopy(cfg)
    leave_unmeasured(checked)
    try:
        validate(checked)
        check_run(checked)
        _check_writable(checked.paths.cache, "paths.cache")
        OmegaConf.resolve(cfg.hydra.run)  # with the precision in the hash of the configuration
    except OmegaConfBaseException as error:
        raise ConfigError(one_line(error)) from None
    _check_writable(cfg.hydra.run.dir, "hydra.run.dir")
    refuse_foreign(Path(cfg.hydra.run.dir), cfg)


def check_sweep(overrides: list[str]) -> None:
    """Refuse keys and options that do not exist, in one line; what a job cannot run with, that job says.

    Raises:
        ConfigError: With one line.
    """
    first, others = [], []
    try:
        for override in OverridesParser.create().parse_overrides(overrides):
            if not override.is_sweep_override():
                first.append(str(override.input_line))
            elif not isinstance(override.value(), Glob):  # which takes what there is
                values = [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
                if not values:
                    raise ConfigError(f"{override.input_line} names no value: nothing would run")
                first.append(values[0])
                others += (
                    values[1:] if override.get_key_element() in Config.__dataclass_fields__ and not override.is_add() else []
                )
        cfg = composed_as_typed(first, return_hydra_config=True)
        leave_unmeasured(cfg)
        check_schema(cfg, only_keys=True)
        _check_writable(cfg.paths.cache, "paths.cache")
        _check_jobs(cfg.hydra)
        for option in others:
            if OmegaConf.is_config(cfg[option.split("=")[0]]):
                composed_as_typed([*first, option])
    except (HydraException, OmegaConfBaseException, RecursionError) as error:
        raise ConfigError(one_line(error)) from None


def leave_unmeasured(cfg: DictConfig) -> None:
    """Give ``precision=auto`` a value: no check depends on it, and it may take seconds to measure."""
    if OmegaConf.is_interpolation(cfg, "precision"):
        cfg.precision = "fp32"


def _check_jobs(hydra: DictConfig) -> None:
    """Where jobs go, and how many run at once."""
    _check_writable(hydra.sweep.dir, "hydra.sweep.dir")
    below = PurePath(str(OmegaConf.to_container(hydra.sweep)["subdir"]))  # type: ignore[index, call-overload]
    if below.is_absolute() or ".." in below.parts:
        raise ConfigError(f"hydra.sweep.subdir={below} is not below the folder of the sweep: leave it out")
    jobs = hydra.launcher.get("n_jobs", 1)
    if type(jobs) is not int or jobs == 0:
        raise ConfigError(f"hydra.launcher.n_jobs={jobs} is no number of jobs: give how many run at once, or -1 for all cores")


def _check_writable(folder: Any, key: str) -> None:
    if not str(folder).strip() or not writable(Path(str(folder))):
        raise ConfigError(f"{key}={folder} cannot be written: choose another folder")
