"""An installed wheel works outside the repository: it carries conf/ and models/, and brings the `see2act` command."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_every_package_is_listed() -> None:
    """Setuptools is given a list, since the folder is called src and the package see2act."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {path.parent for path in (ROOT / "src").rglob("__init__.py")}
    names = {".".join(["see2act", *path.relative_to(ROOT / "src").parts]) for path in found}
    assert listed == names | {"see2act.conf", "see2act.models"}


def test_make_says_how_to_get_another_python(tmp_path: Path) -> None:
    """`make` looks for python3.11, then for uv's, and then says how to get one. No work begins."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "assets.txt"):
        shutil.copy(ROOT / name, tmp_path)
    programs = {
        "python3": f"exec '{sys.executable}' -c 'import sys; sys.version_info = (3, 13); exec(sys.argv[1])' \"$2\"",
        "uv": "exit 1",
    }
    for name in ("make", "sh"):
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).symlink_to(shutil.which(name) or "")
    for name, line in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    install = {"args": ["make", "install"], "cwd": tmp_path, "env": {"PATH": str(tmp_path / "bin")}}
    done = subprocess.run(**install, capture_output=True, text=True)
    assert done.returncode != 0
    assert "uv python install 3.11" in done.stderr
    assert not (tmp_path / ".venv").exists()
    (tmp_path / "bin" / "uv").write_text(f"#!/bin/sh\necho {tmp_path}/found\n")
    done = subprocess.run(**install, capture_output=True, text=True)
    assert f"{tmp_path}/found" in done.stderr  # which make has tried


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel in it. Its dependencies are those of this one."""
    folder = tmp_path_factory.mktemp("installed")
    source = folder / "source"  # a copy, since setuptools leaves its work in the folder
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("src", "conf", "models"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    wheel = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(folder),
        str(source),
    ]
    subprocess.run(wheel, check=True, timeout=300)
    venv.create(folder / "env", with_pip=False)
    (site,) = (folder / "env").glob("lib/python*/site-packages")
    # A path is not a site folder: the .pth files in it, the editable install's among them, are not read.
    (site / "dependencies.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    (built,) = folder.glob("*.whl")
    target = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(folder / "env" / "bin" / "python"),
        "install",
        "--quiet",
        "--no-deps",
    ]
    subprocess.run([*target, str(built)], check=True, timeout=300)
    return folder / "env" / "bin" / "see2act"


def test_the_command_lists_its_commands(installed: Path, tmp_path: Path) -> None:
    done = subprocess.run([installed], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    assert all(f"\n  {name} " in done.stdout for name in ("train", "report", "predict", "demo", "heatmaps"))
    done = subprocess.run([installed, "tain"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "")
    assert (
        done.stderr == "see2act: there is no command 'tain': choose one of train, report, predict, demo, heatmaps, real, coco\n"
    )


@pytest.mark.slow
def test_a_run_and_a_demo_from_another_folder(installed: Path, tmp_path: Path) -> None:
    few = ["collect.interactions=2", "finetune.attempts=0", "evaluate.attempts.seen=1", "evaluate.attempts.unseen=1"]
    tiny = ["task=none", "transfer=none", "model.width=4", "threads=1", "logger=none", "figures.scenes=1", *few]
    done = subprocess.run([installed, "train", *tiny], cwd=tmp_path, timeout=300, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    (result,) = tmp_path.glob("outputs/suction/fcn7/none-none/*/seed0/result.json")
    assert json.loads(result.read_text())["eval"]["seen"]["attempts"] == 1
    demo = [installed, "demo", "--no-film", "evaluate.attempts.unseen=1"]
    done = subprocess.run(demo, cwd=tmp_path, timeout=300, capture_output=True, text=True)  # with one of models/
    assert done.returncode == 0, done.stderr[-2000:]
    assert list(tmp_path.glob("demo/*/strip.png"))
