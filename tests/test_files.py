from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest

from see2act.experiment import identity
from see2act.experiment.cache import once
from see2act.files import replacing, sweep_up, write_json


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_json(path, {"a": 1})
    before = path.read_text()

    def fail_half_way() -> None:
        with replacing(path) as partial:
            partial.write_text("half of")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail_half_way()
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_kill_left_half_written_is_swept_up(tmp_path: Path) -> None:
    write_json(tmp_path / "checkpoints" / "kept.json", 1)
    for left in (tmp_path / "checkpoints" / ".last.ckpt.123.partial", tmp_path / ".thing.123.partial"):
        left.write_text("half of")
    assert once(tmp_path / "thing", lambda: write_json(tmp_path / "thing", 1))
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoints", "thing", "thing.lock"}
    elsewhere = tmp_path / ".cache" / "collections" / ".other.npz.7.partial"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text("of a process that is at work")
    sweep_up(tmp_path)
    assert elsewhere.exists()
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["kept.json"]


def _make(path: Path) -> None:
    def slowly() -> None:
        with replacing(path) as partial:
            time.sleep(0.5)
            partial.write_text("made")
        with (path.parent / "count").open("a") as file:
            file.write("x")

    once(path, slowly)


def test_of_two_processes_one_makes_and_both_have(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    jobs = [context.Process(target=_make, args=(tmp_path / "thing",)) for _ in range(2)]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join(60)
    assert [job.exitcode for job in jobs] == [0, 0]
    assert (tmp_path / "count").read_text() == "x"


def test_a_failed_make_is_made_again(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        once(tmp_path / "thing", fail)
    assert once(tmp_path / "thing", lambda: write_json(tmp_path / "thing", 1))


def test_the_version_of_code_is_what_it_does_wherever_it_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identity, "SOURCES", tmp_path)
    hashes = []
    for source in (
        '"""Adds."""\ndef f(x):\n    return x + 1\n',
        "def f(x):\n    # one more\n    return (x + 1)\n",
        "def f(x):\n    return x + 2\n",
    ):
        (tmp_path / "a.py").write_text(source)
        identity.code_hash.cache_clear()
        hashes.append(identity.code_hash("a.py"))
    assert hashes[0] == hashes[1] != hashes[2]
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert identity.code_hash("b.py") == hashes[2]
