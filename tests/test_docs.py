"""The docs site: it builds without a warning, and its commands and keys exist."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from see2act.errors import ConfigError
from see2act.experiment.config import composed

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
LONG = 150
"""Lines of the README, at most."""


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=300, env=quiet)
    assert done.returncode == 0, done.stderr
    configuration = (tmp_path / "site" / "reference" / "configuration.html").read_text()
    assert "finetune.temperature" in configuration
    assert "softmax" in configuration
    assert "see2act.datamodules.labels.Task" in (tmp_path / "site" / "reference" / "api.html").read_text()


def test_files_that_pages_name_exist() -> None:
    diagram = re.findall(r'"(\w+(?:/\w+)*\.py)"\)', (ROOT / "docs" / "pictures.py").read_text())
    assert len(diagram) >= 10
    named = [f"src/{file}" for file in diagram]
    for page in PAGES:
        named += re.findall(r"`((?:src|conf|tests|benchmarks)/[\w/.]+\.(?:py|yaml))`", page.read_text())
    assert len(named) > 60
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= LONG


def _lines_of(page: Path) -> list[str]:
    """Lines of shell in a page, with continuations joined."""
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
    return [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]


TRAIN = [(page, line) for page in PAGES for line in _lines_of(page) if re.search(r"(train\.py|see2act train|make train)", line)]


@pytest.mark.parametrize(("page", "line"), TRAIN, ids=lambda value: None if isinstance(value, str) else value.name)
def test_the_configuration_of_each_command_composes(page: Path, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands themselves take minutes to hours; what they ask for must exist."""
    import shlex

    words = shlex.split(line, comments=True)
    if "ARGS=" in line:
        (words,) = ([*shlex.split(word.removeprefix("ARGS="))] for word in words if word.startswith("ARGS="))
    elsewhere = ("PYTHONPATH=", "SEE2ACT_CACHE=", "hydra", "experiment=mine")
    overrides = [_first(word) for word in words if re.match(r"^[\w.+/@]+=", word) and not word.startswith(elsewhere)]
    overrides = [override for override in overrides if not override.endswith("=...")]  # left to the reader
    if any("docs/extending" in word or "/home/" in word for word in words):
        pytest.skip("it needs configuration from elsewhere; tests/test_extending.py runs it")
    try:
        composed(overrides)
    except ConfigError as error:
        pytest.fail(f"{page.name}: {line}: {error}")


def _first(override: str) -> str:
    """The first value of a sweep."""
    key, value = override.split("=", 1)
    if value.startswith("range("):
        value = value.removeprefix("range(").split(",")[0]
    elif value.startswith("glob("):
        return "seed=0"
    elif not value.startswith(("[", "{")):
        value = value.split(",")[0]
    return f"{key}={value}"
