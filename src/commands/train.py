"""The command line of ``train.py``: check first, then work."""

from __future__ import annotations

import logging
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Glob
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from see2act.commands import user_errors_end_the_program
from see2act.errors import ConfigError, MissingWeights, UserError
from see2act.experiment.checks import check_keys, illegal_cell, validate
from see2act.experiment.config import Config, composed_as_typed, config_hash, one_line, register
from see2act.experiment.results import versions
from see2act.experiment.sweep import (
    FAILED,
    LEFT_OUT,
    MISSING,
    OTHER,
    SKIPPED,
    Summary,
    clear_notes,
    finished_elsewhere,
    link,
    note,
    of_this_version,
)
from see2act.files import read_json, sweep_up, writable

log = logging.getLogger("see2act")
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


def main() -> None:
    """Run ``train.py`` with the process's arguments."""
    register()
    with user_errors_end_the_program():
        flags = {argument.split("=")[0] for argument in sys.argv[1:] if argument.startswith("-")}
        if flags and flags <= {"-m", "--multirun"}:
            _check_sweep([argument for argument in sys.argv[1:] if not argument.startswith("-")])
        elif not any(argument.split("=")[0] in FLAGS for argument in sys.argv[1:]):
            _check(sys.argv[1:])
    _hydra_main()
    if Summary.failures:
        sys.exit(1)


def _check(overrides: list[str]) -> None:
    """Compose the configuration as Hydra will, and refuse what cannot run before a folder is made.

    Raises:
        ConfigError: With one line.
    """
    from see2act.experiment import build  # brings pybullet, which --help should not wait for

    if experiment := next((o.split("=")[1] for o in overrides if o.lstrip("+").startswith("experiment=")), None):
        raise ConfigError(
            f"experiment={experiment} is a sweep: add -m, and primitive=, task=, transfer= and seed= if you want one run of it"
        )
    cfg = composed_as_typed(overrides, return_hydra_config=True)
    plain = composed_as_typed(overrides)
    try:
        OmegaConf.resolve(cfg.hydra.run)
        folder = Path(cfg.hydra.run.dir)
        validate(plain)
    except OmegaConfBaseException as error:
        raise ConfigError(one_line(error)) from None
    build.check_run(plain)
    _check_writable(folder)
    _check_writable(Path(plain.paths.cache))
    refuse_foreign(folder, plain)


def _check_sweep(overrides: list[str]) -> None:
    """Refuse keys and options that do not exist, in one line; what a job cannot run with, that job says.

    Raises:
        ConfigError: With one line.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
    except HydraException as error:
        raise ConfigError(one_line(error)) from None
    first, others = [], []
    for override in parsed:
        if not override.is_sweep_override():
            first.append(str(override.input_line))
        elif not isinstance(override.value(), Glob):  # which takes what there is
            value, *more = (f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator())
            first.append(value)
            others += more if override.get_key_element() in Config.__dataclass_fields__ and not override.is_add() else []
    cfg = composed_as_typed(first)
    check_keys(cfg)
    for option in others:
        if OmegaConf.is_config(cfg[option.split("=")[0]]):
            composed_as_typed([*first, option])


def _check_writable(folder: Path) -> None:
    if not writable(folder):
        raise ConfigError(f"{folder} cannot be written: choose another with hydra.run.dir= or paths.cache=")


@hydra.main(version_base="1.3", config_path="pkg://see2act.conf", config_name="train")
def _hydra_main(cfg: DictConfig) -> float | None:
    """A run, or a job of a sweep."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return _job(cfg, folder, Path(HydraConfig.get().sweep.dir).absolute())
    with user_errors_end_the_program():
        return _checked(cfg, folder)


def _job(cfg: DictConfig, folder: Path, sweep: Path) -> float | None:
    """A run of a sweep, or a note why there is none: one job that fails must not end the others."""
    clear_notes(folder)
    cell = f"{cfg.primitive.name}/{cfg.task.name}/{cfg.transfer.name}"
    if reason := illegal_cell(cfg):
        if not cfg.cells:  # of an experiment that names its cells nobody misses the others
            note(folder, SKIPPED, f"{cfg.primitive.name}: {reason}")
        return None
    if cfg.cells and cell not in cfg.cells:
        note(folder, LEFT_OUT, cell)
        return None
    try:
        if not cfg.force and (twin := finished_elsewhere(folder, sweep)):
            link(twin, folder)
        result = folder / "result.json"
        if not cfg.force and (not of_this_version(result) if result.exists() else _begun_by_another_version(folder)):
            note(folder, OTHER, "finished" if result.exists() else "begun, and not finished")
            return None
        return _checked(cfg, folder)
    except MissingWeights as error:
        note(folder, MISSING, str(error))
    except UserError as error:
        log.error("this job failed: %s", error)
        note(folder, FAILED, str(error))
    except Exception as error:
        log.exception("this job failed")
        note(folder, FAILED, f"{type(error).__name__}: {error}")
    return None


def _checked(cfg: DictConfig, folder: Path) -> float:
    from see2act.experiment import build

    validate(cfg)
    build.check_run(cfg)
    return run(cfg, folder)


def identity(cfg: DictConfig) -> dict[str, Any]:
    """What ``run.json`` says of a run's folder: only the same configuration may finish or continue it."""
    return {"config_hash": config_hash(cfg), "seed": cfg.seed}


def refuse_foreign(folder: Path, cfg: DictConfig) -> None:
    """Refuse a folder that holds another run, or half a run that another version of the code began.

    Raises:
        ConfigError: It does.
    """
    known = _begun(folder)
    used = known or any((folder / name).exists() for name in ("result.json", "attempts.csv"))
    if used and {key: known.get(key) for key in identity(cfg)} != identity(cfg):
        raise ConfigError(f"{folder} holds a run of another configuration: choose another hydra.run.dir=, or move it away")
    if _begun_by_another_version(folder) and not (folder / "result.json").exists() and not cfg.force:
        raise ConfigError(
            f"{folder} holds a run that another version of the code or of its packages began: force=true moves it aside and "
            "runs anew"
        )


def _begun(folder: Path) -> dict[str, Any]:
    """What a folder says of its run; of one that a report kept without its ``run.json``, the result says the same."""
    note, result = folder / "run.json", folder / "result.json"
    if note.exists() or not result.exists():
        known: dict[str, Any] = read_json(note) if note.exists() else {}
        return known
    finished = read_json(result)
    return {
        "config_hash": finished.get("config_hash"),
        "seed": finished.get("choices", {}).get("seed"),
        "versions": finished.get("versions"),
    }


def _begun_by_another_version(folder: Path) -> bool:
    known = _begun(folder)
    return bool(known) and known.get("versions") != versions()


def run(cfg: DictConfig, folder: Path) -> float:
    """One run in ``folder``: skipped if finished, continued if cut short.

    Returns:
        The final success rate on unseen objects.

    Raises:
        ConfigError: The folder holds another run, another process works in it, or given weights do not fit.
    """
    refuse_foreign(folder, cfg)
    if cfg.force:
        with _alone(folder):
            _set_aside(folder)
    with _alone(folder):  # a lock of the folder's own: one that was set aside has taken its lock along
        return _run_alone(cfg, folder)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    try:
        with FileLock(folder / ".lock").acquire(timeout=0):
            sweep_up(folder)
            yield
    except Timeout:
        raise ConfigError(f"another process is at work in {folder}: wait for it to end") from None


def _set_aside(folder: Path) -> None:
    """Move a finished run away, and half a run of another version."""
    result = folder / "result.json"
    if not result.exists() and not _begun_by_another_version(folder):
        return
    last = (result if result.exists() else folder / "run.json").stat().st_mtime
    aside = folder.with_name(f"{folder.name}.{time.strftime('%Y%m%d-%H%M%S', time.gmtime(last))}")
    _move_aside(folder, aside)
    log.info("force=true: the earlier run is now in %s", aside)


def _run_alone(cfg: DictConfig, folder: Path) -> float:
    result = folder / "result.json"
    if result.exists():
        by = "" if of_this_version(result) else " by another version of the code"
        log.info("this run is finished already%s; force=true runs it anew: %s", by, result)
        if cfg.robot.get("video") and not (folder / "video.mp4").exists():
            log.info("it was not filmed, and only force=true makes a film of it")
        return float(read_json(result)["eval"]["unseen"]["rate"])
    # Imported late: torch and lightning take seconds, which --help should not.
    import torch

    from see2act.experiment.pipeline import Run
    from see2act.experiment.quiet import quiet
    from see2act.files import write_json

    quiet()
    torch.set_num_threads(cfg.threads)
    # As Ctrl-C does. Lightning would take note, and look at it after the next learning step, which an evaluation keeps waiting.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    job = Run(cfg, folder)
    job.check_weights()
    # Only now: a refused run must not keep the folder to itself.
    write_json(folder / "run.json", identity(cfg) | {"versions": versions()})
    outcome = job()
    _report(outcome, folder)
    return float(outcome["eval"]["unseen"]["rate"])


def _move_aside(folder: Path, aside: Path) -> None:
    folder.rename(aside)  # in one step: half a run is never left behind
    shutil.copytree(aside / ".hydra", folder / ".hydra")  # Hydra has written this run's already
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler) and Path(handler.baseFilename).parent == folder.absolute():
            handler.close()  # it has gone along: the next line begins a file anew


def _report(result: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from see2act.experiment.evaluation import SPLITS
    from see2act.experiment.results import wilson

    choices = result["choices"]
    table = Table(title=" ".join(str(choices[key]) for key in ("primitive", "task", "transfer")) + f" seed {choices['seed']}")
    for column in ("success rate", *(f"{split} objects" for split in SPLITS)):
        table.add_column(column)
    rows = {"zero-shot": "zero_shot", "after fine-tuning": "eval", "the same, plain argmax": "eval_argmax"}
    for name, key in rows.items():
        cells = []
        for split in SPLITS:
            counts = result[key][split]["successes"], result[key][split]["attempts"]
            low, high = wilson(*counts)
            cells.append(f"{result[key][split]['rate']:.2f}  ({counts[0]}/{counts[1]}, 95 % {low:.2f}-{high:.2f})")
        table.add_row(name, *cells)
    console = Console(width=110)
    console.print(table)
    console.print(f"minutes: {sum(result['seconds'].values()) / 60:.1f}", highlight=False)
    for name in ("result.json", "attempts.csv", "transfer.json", "figures", "checkpoints"):
        console.print(f"  {folder / name}", highlight=False, soft_wrap=True)
