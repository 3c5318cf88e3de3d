"""Jobs of a sweep: they may be impossible, be finished elsewhere, or fail without ending the others."""

from __future__ import annotations

import ctypes
import logging
import os
import shutil
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from see2act.errors import DamagedFile, MissingWeights, UserError, storage_errors
from see2act.experiment.checks import impossible_condition
from see2act.experiment.folder import at_work, finishes, half_of_another_version, of_this_version
from see2act.experiment.single import run_checked
from see2act.files import replacing

log = logging.getLogger("see2act")
SKIPPED, LEFT_OUT, MISSING, FAILED, OTHER = "skipped.txt", "left_out.txt", "missing.txt", "failed.txt", "other_version.txt"
"""Notes that a job leaves in its folder: one line each."""
SUMMARY = {
    SKIPPED: "combinations were skipped, since they are impossible",
    LEFT_OUT: "conditions were left out, since the experiment does not name them: conditions=[] runs all that are possible",
    MISSING: "jobs were skipped, since their weights are not here",
    OTHER: (
        "runs are of another version of the code, and were not touched: to run one again, add its primitive=, task=, transfer= "
        "and seed= to the same command, and force=true, which moves the old one aside"
    ),
    FAILED: "jobs FAILED, and run again when the same sweep is started again",
}
COMPOSED = ".hydra/config.yaml"
"""Hydra writes one for each job."""
ENDS = ("result.json", *SUMMARY)
"""What a job leaves one of, unless it was killed. One that an experiment does not name may leave nothing, and begins no run."""
OF_CONDITIONS, NOT_RUN = (SKIPPED, LEFT_OUT), (MISSING, OTHER, FAILED)
"""Notes that say the same of all seeds, and notes of one run."""


class Summary(Callback):
    """Logs at the end of a sweep what was not run, and why.

    Hydra makes one for the whole sweep and one in each job.
    """

    failures = 0
    """Jobs of this process's sweep that failed."""
    of_sweep: Summary | None = None
    """The one of this process's sweep."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this before the first job."""
        Summary.of_sweep = self
        self._config, self._earlier, self._queue = config, _written(Path(config.hydra.sweep.dir)), None
        if OmegaConf.select(config, "hydra.launcher._target_", default="").endswith(".SlurmLauncher"):
            from see2act.experiment.slurm import watch_queue  # submitit is an extra

            self._queue = watch_queue()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Hydra calls this after each job, and would keep two whole configurations of each until the last."""
        job_return.cfg = job_return.hydra_cfg = None

    def broken_off(self) -> None:
        """Log the same of a sweep that its launcher gave up, as all launchers do when a job is killed.

        Jobs that SLURM has been given go on, and are waited for.
        """
        if self._queue:
            log.info("a job was lost; the others go on (Ctrl-C does not end them, scancel does)")
            self._queue.wait_for_all()
        self._summarise(self._config, broken_off=True)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this after the last job."""
        self._summarise(config, broken_off=False)

    def _summarise(self, config: DictConfig, *, broken_off: bool) -> None:
        """Jobs run in processes of their own, so this looks for the notes that they leave."""
        folder = Path(config.hydra.sweep.dir)
        # By the clock alone it cannot be told what is new: it may jump, and that of a shared disk may be another one.
        new = sorted(path for path, when in _written(folder).items() if self._earlier.get(path) != when)
        for name, words in SUMMARY.items():
            notes = [path for path in new if path.name == name]
            lines = [f"{note.parent.relative_to(folder)}: {note.read_text()}" for note in notes]
            if name in OF_CONDITIONS:
                lines = sorted({note.read_text() for note in notes})
            if lines:
                log.info("%d %s:\n  %s", len(lines), words, "\n  ".join(lines))
            if name == FAILED:
                Summary.failures = len(lines)
        jobs = [path.parent.parent for path in new if path.match(COMPOSED)]
        lost = [job for job in jobs if (job / "run.json").exists() and not any((job / end).exists() for end in ENDS)]
        if not broken_off:  # another sweep may be at work in the same folder; of one broken off, killed jobs may seem to be
            lost = [job for job in lost if not at_work(job)]
        if lost:
            names = "\n  ".join(str(job.relative_to(folder)) for job in lost)
            log.error(
                "%d jobs were begun and are not finished; they go on when the same sweep is started again:\n  %s",
                len(lost),
                names,
            )
            Summary.failures += len(lost)
        if jobs and not any((job / name).exists() for job in jobs for name in ("run.json", "result.json", *NOT_RUN)):
            log.error("not one job ran: none of these combinations is possible and a condition of the experiment")
            Summary.failures += 1


def _written(folder: Path) -> dict[Path, int]:
    """Notes and configurations of jobs, and when each was written."""
    return {path: path.stat().st_mtime_ns for name in (*SUMMARY, COMPOSED) for path in folder.rglob(name)}


def run_job(cfg: DictConfig, folder: Path, sweep: Path) -> float | None:
    """One job of a sweep: run it, or leave a note why it did not run. One job that fails must not end the others.

    Args:
        cfg: Of the job.
        folder: Of the job.
        sweep: Folder of the sweep.

    Returns:
        The final success rate on unseen objects; None if it did not run.
    """
    _clear_notes(folder)
    condition = f"{cfg.primitive.name}/{cfg.task.name}/{cfg.transfer.name}"
    if reason := impossible_condition(cfg):
        if not cfg.conditions:  # an experiment that names its conditions does not expect the others
            _note(folder, SKIPPED, f"{cfg.primitive.name}: {reason}")
        return None
    if cfg.conditions and condition not in cfg.conditions:
        _note(folder, LEFT_OUT, condition)
        return None
    try:
        if not cfg.force and (duplicate := finished_elsewhere(folder, sweep, cfg)):
            link(duplicate, folder)
        result = folder / "result.json"
        if not cfg.force and (not of_this_version(result) if result.exists() else half_of_another_version(folder, cfg)):
            _note(folder, OTHER, "finished" if result.exists() else "begun, and not finished")
            return None
        with storage_errors():
            return run_checked(cfg, folder)
    except MissingWeights as error:
        _note(folder, MISSING, str(error))
    except UserError as error:
        log.error("this job failed: %s", error)
        _note(folder, FAILED, str(error))
    except Exception as error:
        log.exception("this job failed")
        _note(folder, FAILED, f"{type(error).__name__}: {error}")
    finally:
        _give_back_memory()
    return None


def _give_back_memory() -> None:
    """Return freed memory to the system. Otherwise glibc's heap grows by 0.2 MB with each job that runs in the same process."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # other C libraries have none
    if trim:
        trim(0)


def _note(folder: Path, name: str, text: str) -> None:
    """Leave a note of one line in a job's folder. If it cannot be written, as on a full disk, the log has it."""
    line = " ".join(text.split())
    try:
        with replacing(folder / name) as partial:
            partial.write_text(line)
    except OSError as error:
        log.error("%s could not be written (%s): %s", folder / name, error, line)


def _clear_notes(folder: Path) -> None:
    """Remove those of an earlier try."""
    for name in SUMMARY:
        (folder / name).unlink(missing_ok=True)


def finished_elsewhere(folder: Path, sweep: Path, cfg: DictConfig) -> Path | None:
    """The same run, finished by this version of the code at the same place in another experiment's sweep.

    None where there is none, or where this folder has begun its own.
    """
    if any((folder / name).exists() for name in ("run.json", "result.json")):
        return None
    others = sorted(sweep.parent.glob(f"*/{folder.absolute().relative_to(sweep)}/result.json"))
    return next((result.parent for result in others if _usable(result, cfg)), None)


def _usable(result: Path, cfg: DictConfig) -> bool:
    try:
        return finishes(result, cfg)
    except DamagedFile:  # whoever goes on with that sweep is told
        return False


def link(duplicate: Path, folder: Path) -> None:
    """Make everything a finished run left appear in ``folder`` too.

    By hard links, which take no room and last when the other run is moved aside or deleted. An interrupted link is completed.
    """
    # A result means done, so it comes after all that belongs to it; run.json alone would mean half a run.
    for path in sorted(duplicate.iterdir(), key=lambda path: (path.name == "run.json", path.name == "result.json")):
        there = folder / path.name
        if path.name.startswith(".") or path.name in SUMMARY:
            continue
        if path.is_dir():
            shutil.copytree(path, there, copy_function=_share, dirs_exist_ok=True)
        else:
            _share(path, there)
    log.info("the same run is finished in %s: linked, not run again", duplicate)


def _share(path: str | Path, there: str | Path) -> None:
    try:
        os.link(path, there)
    except FileExistsError:
        return
    except OSError:  # a file system without hard links
        with replacing(Path(there)) as partial:
            shutil.copy2(path, partial)
