"""What the campaigns of disturbances share: tiny real commands, and what must be the same after any disturbance."""

from __future__ import annotations

import csv
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import torch
from safetensors.torch import load_file

from see2act.datamodules.collect import Collection
from see2act.errors import DamagedFile
from see2act.experiment.checkpoints import load_checkpoint
from see2act.experiment.results import read_result
from see2act.files import read_json

ROOT = Path(__file__).parents[1]
TINY = (
    *("threads=1", "precision=fp32", "model.width=4", "figures.scenes=1", "collect.interactions=12", "pretrain.epochs=1"),
    *("pretrain.batch_size=4", "pretrain.test_scenes=2", "finetune.attempts=6", "finetune.episode_attempts=2"),
    *("finetune.updates=2", "finetune.batch_size=4", "evaluate.attempts.seen=2", "evaluate.attempts.unseen=2"),
)
"""Everything is real but the numbers."""
MARK = "SEE2ACT_DISTURBED"
"""Environment variable by which a command's processes are known."""
LEFT = (".png", ".json", ".csv", ".safetensors", ".ckpt")
"""Endings of the files that a run leaves."""
LIMIT = 900.0
"""Seconds after which a command is given up."""


@dataclass
class Command:
    """A command of the project, started once, in a folder of its own.

    Args:
        arguments: What is typed after ``python``.
        cwd: Where.
        log: Gets what it prints.
        environment: Variables in addition to those of this process.
        prefix: What is typed before ``python``.
    """

    arguments: Sequence[str]
    cwd: Path
    log: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    prefix: Sequence[str] = ()

    def __post_init__(self) -> None:
        self.mark = uuid4().hex
        known = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **self.environment, MARK: self.mark}
        with self.log.open("w") as out:
            self.process = subprocess.Popen(
                [*self.prefix, sys.executable, *self.arguments],
                cwd=self.cwd,
                env=known,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def printed(self) -> str:
        """Everything up to now."""
        return self.log.read_text(errors="replace")

    def wait(self) -> int:
        """Its exit status, when it has ended."""
        return self.process.wait(timeout=LIMIT)

    def processes(self) -> list[int]:
        """Processes that it started, itself among them, that have not ended."""
        found = []
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                try:
                    if f"{MARK}={self.mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                        found.append(int(folder.name))
                except OSError:  # ended meanwhile; that of a dead process whose parent has not asked for it is empty
                    continue
        return found

    def orphans(self, patience: float = 15.0) -> list[int]:
        """Processes that go on after the command has ended, and still do after some seconds."""
        deadline = time.monotonic() + patience
        while (left := self.processes()) and time.monotonic() < deadline:
            time.sleep(0.2)
        return left


def train(folder: Path, cache: Path, *overrides: str) -> list[str]:
    """Arguments of one run."""
    return [str(ROOT / "train.py"), *TINY, *overrides, f"hydra.run.dir={folder}", f"paths.cache={cache}"]


def sweep(folder: Path, cache: Path, *overrides: str) -> list[str]:
    """Arguments of a sweep with two workers."""
    where = (f"hydra.sweep.dir={folder}", f"paths.cache={cache}", "hydra.launcher.n_jobs=2")
    return [str(ROOT / "train.py"), "-m", *TINY, *overrides, *where]


def outcome(run: Path) -> dict[str, Any]:
    """Everything that a run's seed and configuration decide: its attempts, its result and its weights."""
    with (run / "attempts.csv").open() as file:
        attempts = [{key: text for key, text in row.items() if not key.startswith("t_")} for row in csv.DictReader(file)]
    checkpoints = run / "checkpoints"
    weights = {"model": _tensors(load_file(checkpoints / "model.safetensors"))}
    weights["affordance"] = _tensors(load_checkpoint(checkpoints / "affordance.ckpt", ("state_dict",))["state_dict"])
    if (checkpoints / "vision.ckpt").exists():
        weights["vision"] = _tensors(load_checkpoint(checkpoints / "vision.ckpt", ("network",))["network"])
    return {
        "attempts": attempts,
        "result": read_result(run / "result.json").outcomes,
        "transfer": read_json(run / "transfer.json"),
        "weights": weights,
        "files": sorted(path.name for path in run.rglob("*") if path.suffix in LEFT and "wandb" not in path.parts),
    }


def differences(run: Path, undisturbed: Mapping[str, Any]) -> list[str]:
    """Names of what is not the same; "unfinished" where the run has no result."""
    if not (run / "result.json").exists():
        return ["unfinished"]
    found = outcome(run)
    return [key for key, value in undisturbed.items() if found[key] != value]


def damaged_files(cache: Path) -> list[str]:
    """Files of a cache that cannot be read, or were left half written."""
    found = [f"{path.name} is half written" for path in cache.rglob(".*.partial")]
    for path in kept(cache):
        try:
            if path.suffix == ".npz":
                Collection.load(path)
            elif path.suffix == ".ckpt":
                load_checkpoint(path, ("task", "network"))
            else:
                read_json(path)
        except DamagedFile as error:
            found.append(str(error))
    return found


def content(cache: Path) -> dict[str, str]:
    """A digest of what is in each file of a cache, by its path."""
    digests = {}
    for path in kept(cache):
        if path.suffix == ".npz":
            arrays = Collection.load(path).arrays
            digests[str(path.relative_to(cache))] = _digest(b"".join(arrays[key].tobytes() for key in sorted(arrays)))
        elif path.suffix == ".ckpt":
            digests[str(path.relative_to(cache))] = _tensors(load_checkpoint(path, ("network",))["network"])
        elif "evaluations" in path.parts:
            rows = read_json(path)["rows"]
            untimed = [{key: text for key, text in row.items() if not key.startswith("t_")} for row in rows]
            digests[str(path.relative_to(cache))] = _digest(repr(untimed).encode())
    return digests


def kept(cache: Path) -> Iterator[Path]:
    """Files of ours in a cache."""
    ours = (path for path in sorted(cache.rglob("*")) if "wandb" not in path.parts)
    return (path for path in ours if path.suffix in (".npz", ".ckpt", ".json"))


def _tensors(state: Mapping[str, torch.Tensor]) -> str:
    return _digest(b"".join(key.encode() + state[key].contiguous().numpy().tobytes() for key in sorted(state)))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
