"""The command line of ``train.py``: check first, then work."""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import hydra
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from see2act.config import ConfigError, check_arguments, config_hash, illegal_cell, register, validate

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
)
"""With these Hydra does something other than one run and does its own checking."""

SKIPPED = "skipped.txt"
"""In the folder of a sweep's job that made no sense."""


def main() -> None:
    """Run ``train.py`` with the process's arguments."""
    register()
    try:
        if not any(argument.split("=")[0] in FLAGS for argument in sys.argv[1:]):
            _check(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"see2act: {error}")
    _hydra_main()


class SkippedCells(Callback):
    """Lists at the end of a sweep the combinations that were skipped because they make no sense."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this before the first job."""
        self._start = time.time()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this after the last job. Jobs run in processes of their own, so they leave a note each."""
        notes = sorted(Path(config.hydra.sweep.dir).rglob(SKIPPED))
        reasons = [note.read_text() for note in notes if note.stat().st_mtime >= self._start]
        if reasons:
            log.info("%d combinations were skipped:\n  %s", len(reasons), "\n  ".join(reasons))


def _check(overrides: list[str]) -> None:
    """Compose the configuration as Hydra will, and refuse what cannot run before a folder is made.

    Raises:
        ConfigError: With one line.
    """
    from hydra import compose, initialize_config_module

    with initialize_config_module("see2act.conf", version_base="1.3"):
        try:
            cfg = compose("train", overrides, return_hydra_config=True)
            OmegaConf.resolve(cfg.hydra.run)
            folder = Path(cfg.hydra.run.dir)
            plain = compose("train", overrides)
            validate(plain)
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigError(_one_line(error)) from None
    _check_parts(plain)
    _check_writable(folder)
    _check_writable(Path(plain.paths.cache))
    refuse_foreign(folder, plain)


def _one_line(error: Exception) -> str:
    """Hydra's explanation on one line, its tabs and blank lines folded."""
    text = " ".join(str(error).split("Set the environment variable")[0].split())
    if "Could not override" in text and "To append to your config" in text:
        key = text.split("Could not override '")[1].split("'")[0]
        return f"there is no configuration key '{key}': see `python train.py --cfg job` for all of them"
    return text.replace("Available options in", "choose from the options of")


def _check_parts(cfg: DictConfig) -> None:
    """Build what is cheap to build, so that wrong parameters of objects, camera or workspace show now."""
    from hydra.utils import instantiate
    from see2act import build
    from see2act.robot.types import RobotError

    for group in ("policy", "model", "workspace", "camera", "objects", "robot", "task", "primitive"):
        check_arguments(cfg[group], group)
    try:
        instantiate(cfg.workspace)
        instantiate(cfg.camera, _convert_="all")
        instantiate(cfg.objects, _convert_="all")
        build.policy(cfg)
        build.robot_factory(cfg, cfg.primitive)().close()
    except (RobotError, HydraException) as error:
        cause = error.__cause__ or error
        raise ConfigError(" ".join(str(cause).split())) from None


def _check_writable(folder: Path) -> None:
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ConfigError(
            f"{folder} cannot be written, since {existing} is no folder you may write to: "
            "choose another with hydra.run.dir= or paths.cache="
        )


@hydra.main(version_base="1.3", config_path="pkg://see2act.conf", config_name="train")
def _hydra_main(cfg: DictConfig) -> float | None:
    """One job: a run, or in a sweep the notice that a cell makes no sense."""
    sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    folder = Path(HydraConfig.get().runtime.output_dir)
    if sweep and cfg.cells and f"{cfg.primitive.name}/{cfg.task.name}/{cfg.transfer.name}" not in cfg.cells:
        return None
    if sweep and (reason := illegal_cell(cfg)):
        if not cfg.cells:  # of an experiment that names its cells nobody misses the others
            (folder / SKIPPED).write_text(f"{cfg.primitive.name}: {reason}")
        return None
    if sweep and (twin := _finished_elsewhere(folder)):
        _link(twin, folder)
    try:
        validate(cfg)
        _check_parts(cfg)
        return run(cfg, folder)
    except ConfigError as error:
        if sweep:
            raise  # one job that fails must not end the others
        sys.exit(f"see2act: {error}")


def _finished_elsewhere(folder: Path) -> Path | None:
    """The same run, finished in another experiment's sweep; None where there is none or this folder has begun its own."""
    if any((folder / name).exists() for name in ("run.json", "result.json")):
        return None
    sweep = Path(HydraConfig.get().sweep.dir).absolute()
    others = sweep.parent.glob(f"*/{folder.absolute().relative_to(sweep)}/result.json")
    return next((result.parent for result in sorted(others) if not result.is_symlink()), None)


def _link(twin: Path, folder: Path) -> None:
    """Make everything a finished run left appear in ``folder`` too."""
    for path in sorted(twin.iterdir(), key=lambda path: path.name == "result.json"):  # which means done, so it comes last
        if not path.name.startswith(".") and not (folder / path.name).exists():
            (folder / path.name).symlink_to(os.path.relpath(path, folder))
    log.info("the same run is finished in %s: linked, not run again", twin)


def identity(cfg: DictConfig) -> dict[str, Any]:
    """What ``run.json`` says of a run's folder: only the same configuration may finish or continue it."""
    return {"config_hash": config_hash(cfg), "seed": cfg.seed}


def refuse_foreign(folder: Path, cfg: DictConfig) -> None:
    """Refuse a folder that holds another run.

    Raises:
        ConfigError: It does.
    """
    note = folder / "run.json"
    known = json.loads(note.read_text()) if note.exists() else None
    used = known or any((folder / name).exists() for name in ("result.json", "attempts.csv"))
    if used and known != identity(cfg):
        raise ConfigError(f"{folder} holds a run of another configuration: choose another hydra.run.dir=, or move it away")


def run(cfg: DictConfig, folder: Path) -> float:
    """One run in ``folder``: skipped if finished, continued if cut short.

    Returns:
        The final success rate on unseen objects.

    Raises:
        ConfigError: The folder holds another run, another process works in it, or given weights do not fit.
    """
    refuse_foreign(folder, cfg)
    lock = FileLock(folder / ".lock")
    try:
        with lock.acquire(timeout=0):
            return _run_alone(cfg, folder)
    except Timeout:
        raise ConfigError(f"another process is at work in {folder}: wait for it to end") from None


def _run_alone(cfg: DictConfig, folder: Path) -> float:
    result = folder / "result.json"
    if result.exists() and cfg.force:
        aside = folder.with_name(f"{folder.name}.{time.strftime('%Y%m%d-%H%M%S', time.gmtime(result.stat().st_mtime))}")
        _move_aside(folder, aside)
        log.info("force=true: the earlier run is now in %s", aside)
    if result.exists():
        log.info("this run is finished already; force=true runs it anew: %s", result)
        if cfg.robot.get("video") and not (folder / "video.mp4").exists():
            log.info("it was not filmed, and only force=true makes a film of it")
        return float(json.loads(result.read_text())["eval"]["unseen"]["rate"])
    # Imported late: torch and lightning take seconds, which --help should not.
    import torch
    from see2act.files import write_json
    from see2act.modules.transfer import TransferError
    from see2act.pipeline import Run
    from see2act.quiet import quiet

    quiet()
    torch.set_num_threads(cfg.threads)
    job = Run(cfg, folder)
    try:
        job.check_weights()
    except TransferError as error:
        raise ConfigError(str(error)) from None
    write_json(folder / "run.json", identity(cfg))  # only now: a refused run must not keep the folder to itself
    outcome = job()
    _report(outcome, folder)
    return float(outcome["eval"]["unseen"]["rate"])


def _move_aside(folder: Path, aside: Path) -> None:
    folder.rename(aside)  # in one step: half a run is never left behind
    shutil.copytree(aside / ".hydra", folder / ".hydra")  # Hydra has written this run's already


def _report(result: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table
    from see2act.evaluation import SPLITS
    from see2act.statistics import wilson

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
