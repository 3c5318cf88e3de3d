"""Things that are expensive to make and depend on nothing but their configuration: made once, kept by hash."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import logging
import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

log = logging.getLogger("see2act")
SOURCES = Path(__file__).parents[1]


def code_hash(*places: str) -> str:
    """Twelve hexadecimal digits of the source files in folders or files of this package, comments and docstrings aside.

    Part of a cache's keys: what another version of the code made is never taken for this one's.
    """
    digest = hashlib.sha256()
    for place in places:
        path = SOURCES / place
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(f"{file.relative_to(SOURCES).as_posix()} {_meaning(file.read_text())}".encode())
    return digest.hexdigest()[:12]


def foreign_code(node: Any) -> dict[str, str]:
    """Hash of the source file of each ``_target_`` in plain configuration that is neither ours nor an installed package's."""
    if isinstance(node, list):
        return {name: digest for item in node for name, digest in foreign_code(item).items()}
    if not isinstance(node, dict):
        return {}
    found = {name: digest for value in node.values() for name, digest in foreign_code(value).items()}
    module = str(node.get("_target_", "")).rpartition(".")[0]
    if module and not module.startswith("see2act."):
        spec = _spec(module)
        if spec and spec.origin and spec.origin.endswith(".py") and not Path(spec.origin).is_relative_to(sys.prefix):
            found[spec.name] = hashlib.sha256(_meaning(Path(spec.origin).read_text()).encode()).hexdigest()[:12]
    return found


def _spec(name: str) -> ModuleSpec | None:
    """Of the module that a name is in: of ``package.module.Class`` that of ``package.module``."""
    while name:
        try:
            return importlib.util.find_spec(name)
        except ModuleNotFoundError:
            name = name.rpartition(".")[0]
    return None


def given_files(config: dict[str, Any]) -> dict[str, Any]:
    """Plain configuration with digests in place of the paths of weights and of objects' meshes: what they hold decides."""
    config = {key: dict(value) if isinstance(value, dict) else value for key, value in config.items()}
    task, objects = config.get("task", {}), config.get("objects", {})
    if task.get("weights") and Path(task["weights"]).is_file():
        task["weights"] = hashlib.sha256(Path(task["weights"]).read_bytes()).hexdigest()
    folder = Path(objects.get("path") or "nowhere").expanduser()
    if folder.is_dir():
        digest = hashlib.sha256()
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            digest.update(f"{file.relative_to(folder).as_posix()} ".encode() + file.read_bytes())
        objects["path"] = digest.hexdigest()
    return config


def _meaning(source: str) -> str:
    """What the interpreter makes of a source file, without strings that stand alone."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [s for s in body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]  # type: ignore[attr-defined]
    return ast.dump(tree)


def once(path: Path, make: Callable[[], None]) -> bool:
    """Call ``make``, which must write ``path`` atomically, unless the file is there.

    Of several processes that need the same file at the same time one makes it and the others wait.

    Returns:
        Whether it was made now.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{path}.lock")
    try:
        lock.acquire(timeout=1)
    except Timeout:
        log.info("waiting for another process, which is making %s", path)
        lock.acquire()
    try:
        for partial in path.parent.glob(f".{path.name}.*.partial"):  # of a process that was killed while it wrote
            partial.unlink(missing_ok=True)
        if path.exists():
            return False
        make()
        if not path.exists():
            raise RuntimeError(f"nothing was written to {path}")
        return True
    finally:
        lock.release()
