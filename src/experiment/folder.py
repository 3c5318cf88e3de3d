"""A run's folder: whose it is, who works in it, and whether it is finished."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig

from see2act.errors import ConfigError
from see2act.experiment.attended import attended
from see2act.experiment.identity import config_hash, versions
from see2act.files import damaged, read_json, sweep_up, write_json

log = logging.getLogger("see2act")


def claim(folder: Path, cfg: DictConfig) -> None:
    """Write down whose folder it is: only the same configuration may finish or continue the run."""
    earlier = earlier_versions(folder)
    if begun_by_another_version(folder):
        began, now = _begun(folder)["versions"], versions()
        changed = [name for name in {**began, **now} if began.get(name) != now.get(name)]
        changes = ", ".join(f"{name} {began.get(name)} -> {now.get(name)}" for name in changed)
        log.warning("another version began this run, which goes on since its attempts cannot be made again: %s", changes)
        earlier = [*earlier, began]
    write_json(folder / "run.json", _identity(cfg) | {"versions": versions(), "earlier_versions": earlier})


def earlier_versions(folder: Path) -> list[dict[str, str]]:
    """Versions of code and packages that worked at the run before the one that claimed it last, oldest first."""
    earlier: list[dict[str, str]] = _begun(folder).get("earlier_versions", [])
    return earlier


def refuse_foreign(folder: Path, cfg: DictConfig) -> None:
    """Refuse a folder that holds another run, or half a run that another version of the code began.

    Half a run of an attended robot goes on all the same, since its attempts cannot be made again.

    Raises:
        ConfigError: It does.
    """
    known = _begun(folder)
    used = known or any((folder / name).exists() for name in ("result.json", "attempts.csv"))
    if used and {key: known.get(key) for key in _identity(cfg)} != _identity(cfg):
        raise ConfigError(f"{folder} holds a run of another configuration: choose another hydra.run.dir=, or move it away")
    if half_of_another_version(folder, cfg) and not cfg.force:
        raise ConfigError(
            f"{folder} holds a run that another version of the code or of its packages began: force=true moves it aside and "
            "starts again"
        )


def half_of_another_version(folder: Path, cfg: DictConfig) -> bool:
    """Whether half a run is there that this version of the code must not go on with."""
    return begun_by_another_version(folder) and not (folder / "result.json").exists() and not attended(cfg)


def begun_by_another_version(folder: Path) -> bool:
    """Whether a run was begun there by other code, or with other packages."""
    known = _begun(folder)
    return bool(known) and known.get("versions") != versions()


def of_this_version(result: Path) -> bool:
    """Whether the run of a ``result.json`` was made by this code and these packages.

    Raises:
        DamagedFile: It is none.
    """
    return bool(_record(result).get("versions") == versions())


def finishes(result: Path, cfg: DictConfig) -> bool:
    """Whether a ``result.json`` is of the very run that ``cfg`` describes, made by this version.

    Raises:
        DamagedFile: It is none.
    """
    return _of_result(_record(result)) == _identity(cfg) | {"versions": versions()}


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes out.

    Raises:
        ConfigError: Another process works there.
    """
    try:
        with FileLock(folder / ".lock").acquire(timeout=0):
            sweep_up(folder)
            yield
    except Timeout:
        raise ConfigError(f"another process is at work in {folder}: wait for it to end") from None


def at_work(folder: Path) -> bool:
    """Whether a process is at work there."""
    try:
        with FileLock(folder / ".lock").acquire(timeout=0):
            return False
    except Timeout:
        return True


def set_aside(folder: Path) -> None:
    """Rename the folder of a finished run, or of half a run of another version, by the time it was last written."""
    result = folder / "result.json"
    if not result.exists() and not begun_by_another_version(folder):
        return
    last = (result if result.exists() else folder / "run.json").stat().st_mtime
    aside = folder.with_name(f"{folder.name}.{time.strftime('%Y%m%d-%H%M%S', time.gmtime(last))}")
    folder.rename(aside)  # in one step: half a run is never left behind
    shutil.copytree(aside / ".hydra", folder / ".hydra")  # Hydra has written this run's already
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler) and Path(handler.baseFilename).parent == folder.absolute():
            handler.close()  # it has moved along: the next line begins a new file
    log.info("force=true: the earlier run is now in %s", aside)


def _identity(cfg: DictConfig) -> dict[str, Any]:
    return {"config_hash": config_hash(cfg), "seed": cfg.seed}


def _begun(folder: Path) -> dict[str, Any]:
    """What a folder says of its run. A run that a report kept has no ``run.json``; its result says the same."""
    note, result = folder / "run.json", folder / "result.json"
    if note.exists() or not result.exists():
        return _record(note) if note.exists() else {}
    return _of_result(_record(result))


def _of_result(finished: dict[str, Any]) -> dict[str, Any]:
    return {
        "config_hash": finished.get("config_hash"),
        "seed": finished.get("choices", {}).get("seed"),
        "versions": finished.get("versions"),
    }


def _record(path: Path) -> dict[str, Any]:
    """A ``run.json`` or ``result.json``, as far as this module looks at it.

    Raises:
        DamagedFile: It is none.
    """
    known = read_json(path)
    kinds = {"versions": dict, "choices": dict, "earlier_versions": list}
    if not isinstance(known, dict) or not all(isinstance(known.get(key, kind()), kind) for key, kind in kinds.items()):
        raise damaged(path, ValueError("it is no record of a run"))
    return known
