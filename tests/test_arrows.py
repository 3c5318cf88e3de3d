"""Imports run one way: robot and modules know neither each other nor what is built on them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
BANNED = {
    "robot": ("torch", "lightning", "see2act.modules", "see2act.datamodules", "time", "datetime", "random"),
    "modules": ("pybullet", "see2act.robot", "see2act.datamodules"),
    "datamodules": ("see2act.pipeline",),
    "report": ("torch", "lightning", "pybullet", "see2act.modules", "see2act.datamodules", "see2act.pipeline"),
}


@pytest.mark.parametrize("room", BANNED)
def test_room_imports_nothing_it_must_not_know(room: str) -> None:
    files = list((SRC / room).glob("*.py"))
    assert files
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names += [node.module or "", *(f"{node.module}.{a.name}" for a in node.names)]
            for name in names:
                assert not any(name == banned or name.startswith(f"{banned}.") for banned in BANNED[room]), (
                    f"{file} imports {name}"
                )
