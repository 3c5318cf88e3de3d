"""Runs as they lie in their folders: read, checked, and described by the conditions they were tested under."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm
from yaml import YAMLError

from see2act.errors import DamagedFile
from see2act.experiment import attempts
from see2act.experiment.attempts import UNREADABLE, AttemptRow, fault
from see2act.experiment.identity import LOCAL, LOCAL_ROBOT, LOCAL_TRAINER
from see2act.experiment.results import RunResult, curve, read_result
from see2act.robot.types import Split

OPAQUE = (".hydra", "checkpoints", "figures", "wandb", ".git", ".venv", ".cache")
"""Folders that hold no runs, and may be large."""
CONDITIONS = (
    *("model.", "objects.", "workspace.", "camera.", "robot.", "policy."),
    *("primitive.angles", "primitive.footprint", "primitive.end_effector", "evaluate.attempts", "evaluate.scenes"),
)
"""Beginnings of the keys that two runs must share before their success may be compared."""
LEARNING = ("model.rates",)
"""Those that are how a group learns, and not how it is tested."""
NO_MATTER = (
    "hydra",
    *LOCAL,
    "cells",  # what conditions were called before
    *(f"trainer.{key}" for key in LOCAL_TRAINER),
    "trainer.enable_",
    "collect.workers",
    *(f"robot.{key}" for key in LOCAL_ROBOT),
)
"""Beginnings of the keys that leave results as they are."""
NAMED = ("model", "objects", "workspace", "camera", "policy", "precision")
"""Conditions that ``choices`` of a result has."""
UNKNOWN = "unknown"
CONFIGURATION = "configuration"
"""Key of a protocol: ``read``, or ``unknown`` of runs that have lost theirs."""
NO_YAML = (OSError, ValueError, TypeError, AttributeError, RecursionError, OmegaConfBaseException, YAMLError)
"""What reading a damaged configuration may raise."""
ATTEMPTS = ("attempts.csv.gz", "attempts.csv")
"""Where the attempts of a run are: compressed in runs that were kept."""


@dataclass(frozen=True)
class Run:
    """A finished run."""

    folder: Path
    place: str
    """The folder, from where the search began."""
    result: RunResult
    config: dict[str, str]
    """Flat: ``finetune.logit_scale`` to ``0.25``; empty if the folder has none."""
    overrides: tuple[str, ...] | None
    attempts: list[AttemptRow]
    """Rows of attempts.csv; empty if it cannot be read."""
    protocol: dict[str, str]

    @property
    def seed(self) -> int:
        """Of fine-tuning."""
        return self.result.seed

    @property
    def pretrain_seed(self) -> str:
        """Of the vision model; empty where its configuration is not there."""
        typed = self.config.get("pretrain.seed", "")
        return str(self.seed) if typed == "${seed}" else typed

    @property
    def choices(self) -> dict[str, str]:
        """What was typed, without the seed."""
        return {key: str(value) for key, value in self.result.choices.items() if key != "seed"}

    def counts(self, phase: str, split: Split) -> tuple[int, int]:
        """Successes and attempts; (0, 0) if it was not evaluated then."""
        evaluation = self.result.phase(phase)
        return (evaluation[split].successes, evaluation[split].attempts) if evaluation else (0, 0)

    def scores(self, phase: str, split: Split) -> list[float]:
        """Success rate of each test run; empty if it was not evaluated then."""
        evaluation = self.result.phase(phase)
        return [run.success_rate for run in evaluation[split].runs] if evaluation else []

    @property
    def learning(self) -> tuple[int, int]:
        """Successes and attempts while fine-tuning; (0, 0) without fine-tuning."""
        curve = self.result.curve
        return sum(block.successes for block in curve), sum(block.attempts for block in curve)


@dataclass(frozen=True)
class Unfinished:
    """A run without a result."""

    place: str
    primitive: str
    task: str
    transfer: str
    model: str
    seed: str
    state: str


@dataclass
class Holdings:
    """What a folder holds."""

    runs: list[Run] = field(default_factory=list)
    unfinished: list[Unfinished] = field(default_factory=list)
    broken: list[tuple[str, str]] = field(default_factory=list)
    """Folder and reason."""
    notices: list[str] = field(default_factory=list)
    """What a reader must know before believing a number."""


def read(folder: Path) -> Holdings:
    """All runs below ``folder``."""
    held = Holdings()
    for path in tqdm(_once(sorted(_places(folder))), desc="read", disable=None):
        place = path.relative_to(folder).as_posix()
        if not (path / "result.json").is_file():
            held.unfinished.append(_unfinished(path, place))
            continue
        try:
            held.runs.append(_read(path, place, held.notices))
        except (DamagedFile, OSError) as error:
            reason = str(error)
            held.broken.append((place, reason))
            held.notices.append(f"Left out, since its result.json cannot be used: {place} ({reason}).")
    return held


def _places(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(set(folders) - set(OPAQUE))
        if {"result.json", "run.json", *ATTEMPTS} & set(files):
            yield Path(root)


def _once(places: list[Path]) -> list[Path]:
    """Of folders whose result is one and the same file, as in sweeps that share runs, the first."""
    inodes: dict[tuple[int, int], Path] = {}
    kept = []
    for place in places:
        result = place / "result.json"
        if not result.is_file():
            kept.append(place)
            continue
        status = result.stat()
        if inodes.setdefault((status.st_dev, status.st_ino), place) == place:
            kept.append(place)
    return kept


def _read(folder: Path, place: str, notices: list[str]) -> Run:
    result = read_result(folder / "result.json")
    config = _config(folder)
    if result.earlier_versions:
        notices.append(f"{place} was begun by another version of the code or of its packages than the one that finished it.")
    if config is None:
        notices.append(f"{place} has no readable .hydra/config.yaml: its protocol is unknown, so it is kept apart.")
    attempts = _attempts(folder, place, result, notices)
    return Run(folder, place, result, _flat(config), _overrides(folder), attempts, _protocol(result, config))


def _config(folder: Path) -> DictConfig | None:
    try:
        config = OmegaConf.load(folder / ".hydra" / "config.yaml")
        plain: Any = OmegaConf.to_container(config)
        named = plain.get("conditions", plain.get("cells", [])) if isinstance(plain, dict) else None
    except NO_YAML:
        return None
    sensible = isinstance(named, list) and all(isinstance(word, str) and word.count("/") == 2 for word in named)
    return config if isinstance(config, DictConfig) and config and sensible else None


def _flat(config: DictConfig | None) -> dict[str, str]:
    def walk(node: Any, path: str) -> Iterator[tuple[str, str]]:
        if isinstance(node, dict) and node:
            for key, value in node.items():
                yield from walk(value, f"{path}.{key}" if path else str(key))
        else:
            yield path, str(node)

    return dict(walk(OmegaConf.to_container(config), "")) if config else {}


def _overrides(folder: Path) -> tuple[str, ...] | None:
    try:
        # As typed: an interpolation means something within the whole configuration alone.
        overrides: Any = OmegaConf.to_container(OmegaConf.load(folder / ".hydra" / "overrides.yaml"))
    except NO_YAML:
        return None
    return tuple(map(str, overrides)) if isinstance(overrides, list) else None


def _attempts(folder: Path, place: str, result: RunResult, notices: list[str]) -> list[AttemptRow]:
    try:
        rows = attempts.read(attempts_of(folder) or folder / ATTEMPTS[-1])
    except UNREADABLE as error:
        notices.append(f"{place}/attempts.csv cannot be read ({fault(error)}): robot time and causes leave this run out.")
        return []
    if curve(rows) != result.curve:
        notices.append(f"{place}/attempts.csv does not belong to its result.json: robot time and causes leave this run out.")
        return []
    return rows


def attempts_of(folder: Path) -> Path | None:
    """The file with the attempts of a run, if there is one."""
    return next((folder / name for name in ATTEMPTS if (folder / name).is_file()), None)


def _protocol(result: RunResult, config: DictConfig | None) -> dict[str, str]:
    """Everything that two runs must share before their success may be compared."""
    choices = result.choices
    conditions = {
        k.removesuffix(".name"): v for k, v in _flat(config).items() if begins(k, CONDITIONS) and not begins(k, LEARNING)
    }
    protocol = {
        **{key: value for key, value in conditions.items() if not begins(key, NO_MATTER)},
        **{key: str(choices.get(key, UNKNOWN)) for key in NAMED},
        "robot.motion": str(choices.get("motion", UNKNOWN)),
        "evaluate.runs": str(len(result.eval.seen.runs)),
        **{f"version of {name}": str(version) for name, version in result.versions.items()},
    }
    protocol[CONFIGURATION] = UNKNOWN if config is None else "read"
    if config is not None:  # an interpolation, unless it was typed
        protocol["finetune.attempts"] = _chosen(config, "finetune.attempts")
    return protocol


def _chosen(config: DictConfig, key: str) -> str:
    value = OmegaConf.select(config, key, throw_on_resolution_failure=False)
    return UNKNOWN if value is None else str(value)


def begins(key: str, beginnings: Iterable[str]) -> bool:
    """Whether a key is one of these, or below one; a beginning that ends in . or _ takes whatever follows."""
    return any(key == b or key.startswith(b if b[-1] in "._" else f"{b}.") for b in beginnings)


def _unfinished(folder: Path, place: str) -> Unfinished:
    config = _config(folder) or OmegaConf.create()
    names = {key: _chosen(config, f"{key}.name") for key in ("primitive", "task", "transfer", "model")}
    seed, most = _chosen(config, "seed"), _chosen(config, "finetune.attempts")
    if path := attempts_of(folder):
        try:
            done = sum(row.phase == "finetune" for row in attempts.read(path))
            state = f"{done} of {most} fine-tuning attempts done"
        except UNREADABLE:
            state = "its attempts.csv cannot be read"
    else:
        state = "stopped before its first attempt"
    if (failed := folder / "failed.txt").is_file():
        state += f"; failed: {' '.join(failed.read_text(errors='replace').split())}"
    return Unfinished(place, **names, seed=seed, state=state)
