"""Imports run one way: each part of the package knows only the parts that it is built on."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
BASE = {"errors", "files", "seeding"}
CORE = {*BASE, "robot", "modules", "policy", "attempt", "datamodules"}
ALLOWED = {
    "errors": set(),
    "seeding": set(),
    "files": {"errors"},
    "robot": BASE,
    "modules": BASE,
    "policy": {*BASE, "robot"},
    "attempt": {*BASE, "robot", "policy"},
    "datamodules": CORE,
    "experiment": CORE,
    "analysis": {*BASE, "robot", "experiment"},
    "prediction": {*CORE, "experiment"},
    "environment": {*CORE, "experiment"},
    "commands": {*CORE, "experiment", "analysis", "prediction", "environment"},
}
"""For each name at the top of src/, what it may import of the others."""
BANNED = {
    "robot": ("torch", "lightning", "time", "datetime", "random"),
    "modules": ("pybullet", "time", "random"),
    "analysis": ("torch", "lightning", "pybullet", "see2act.experiment.run", "see2act.experiment.stages"),
}
"""What it must not import besides."""
CLOCKS = "robot/real"
"""The one folder of the robot that may read the time."""
TOP = sorted(path.stem for path in SRC.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())


def test_every_name_at_the_top_has_its_place() -> None:
    assert set(TOP) - {"__init__"} == set(ALLOWED)
    assert len(ALLOWED) <= 13


@pytest.mark.parametrize("name", ALLOWED)
def test_imports_only_what_it_is_built_on(name: str) -> None:
    files = [SRC / f"{name}.py"] if (SRC / f"{name}.py").exists() else list((SRC / name).glob("**/*.py"))
    assert files
    for file in files:
        for imported in _imports(file):
            parts = imported.split(".")
            if parts[0] == "see2act" and len(parts) > 1 and parts[1] != name:
                assert parts[1] in ALLOWED[name], f"{file} imports {imported}"
            banned = [word for word in BANNED.get(name, ()) if f"{imported}.".startswith(f"{word}.")]
            assert not banned or (banned == ["time"] and file.is_relative_to(SRC / CLOCKS)), f"{file} imports {imported}"


def _imports(file: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} has a relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names
