"""Hooks of the docs site: the reference of configuration keys is generated, and CONTRIBUTING.md is a page of it."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
MARK = "<!-- configuration -->"
GROUPS = ("task", "transfer", "primitive", "model", "objects", "workspace", "camera", "robot", "policy", "trainer", "logger")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """MkDocs calls this with the text of each page."""
    if page.file.src_uri == "contributing.md":
        return (ROOT / "CONTRIBUTING.md").read_text().replace("(docs/", "(")
    return markdown.replace(MARK, configuration()) if MARK in markdown else markdown


def configuration() -> str:
    """Tables of all keys: those of ``conf/train.yaml``, then each group's options."""
    docs = _docstrings()
    text = ["## All runs", *_table(CONF / "train.yaml", docs, "")]
    for group in GROUPS:
        text += [f"## {group}"]
        for file in sorted((CONF / group).glob("*.yaml")):
            text += [f"### {group}={file.stem}", *_table(file, docs, f"{group}.")]
    return "\n\n".join(text)


@dataclass
class _Key:
    name: str
    value: str
    comment: str


def _table(file: Path, docs: dict[str, str], prefix: str) -> list[str]:
    lines = file.read_text().splitlines()
    head = [line.lstrip("# ") for line in lines[: next((i for i, x in enumerate(lines) if not x.startswith("#")), 0)]]
    head = [line for line in head if not line.startswith("@package")]
    rows = []
    for key in _keys(lines):
        name = f"{prefix}{key.name}"
        words = key.comment or docs.get(name, "")
        if name.split(".")[0] not in ("defaults", "hydra") and not key.name.startswith(("defaults", "hydra")):
            rows.append(f"| `{name}` | {_code(key.value)} | {words.replace('|', chr(92) + '|')} |")
    table = "\n".join(["| key | default | what it is |", "|---|---|---|", *rows])
    return [" ".join(head)] * bool(head) + [table] * bool(rows)


def _keys(lines: list[str]) -> list[_Key]:
    """The keys of a YAML file with the comments behind them; lists and mappings in one line are values."""
    path: list[tuple[int, str]] = []
    found = []
    for line in lines:
        match = re.match(r"^( *)([\w.@]+):(?: (.*))?$", line.rstrip())
        if not match:
            continue
        indent, name, rest = len(match[1]), match[2], match[3] or ""
        path = [(depth, key) for depth, key in path if depth < indent] + [(indent, name)]
        value, _, comment = f" {rest}".partition(" #")
        found.append(_Key(".".join(key for _, key in path), value.strip(), comment.strip()))
    return [key for key in found if key.value and not key.name.endswith(("_target_", "_partial_", "_convert_"))]


def _code(value: str) -> str:
    return f"`{value}`" if value else ""


def _docstrings() -> dict[str, str]:
    """What the schema says under its attributes: ``finetune.temperature`` to its docstring."""
    tree = ast.parse((ROOT / "src" / "experiment" / "config.py").read_text())
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}

    def walk(name: str, prefix: str) -> dict[str, str]:
        found: dict[str, str] = {}
        body = classes[name].body
        for statement, after in zip(body, [*body[1:], None], strict=True):
            if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
                continue
            key = f"{prefix}{statement.target.id}"
            kind = ast.unparse(statement.annotation)
            if kind in classes:
                found |= walk(kind, f"{key}.")
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                found[key] = " ".join(str(after.value.value).replace("``", "`").split())
        return found

    return walk("Config", "")
