from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from see2act.datamodules.workers import end_with_parent
from see2act.errors import DamagedFile, StorageError, storage_errors
from see2act.experiment import identity
from see2act.experiment.cache import once
from see2act.files import HOST, read_arrays, read_json, replacing, sweep_up, write_arrays, write_json


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
    assert once(tmp_path / "thing", lambda: write_json(tmp_path / "thing", 1), read_json) == (1, True)
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoints", "thing", "thing.lock"}
    elsewhere = tmp_path / ".cache" / "collections" / ".other.npz.7.partial"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text("of a process that is at work")
    sweep_up(tmp_path)
    assert elsewhere.exists()
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["kept.json"]


def test_what_a_killed_process_left_of_a_file_goes_when_it_is_written_again(tmp_path: Path) -> None:
    child = multiprocessing.get_context("spawn").Process(target=_killed_while_writing, args=(tmp_path / "a.json",))
    child.start()
    child.join(60)
    assert child.exitcode == -signal.SIGKILL
    other = tmp_path / f".a.json.{HOST}.{os.getppid()}.partial"  # of a process that is at work
    other.touch()
    assert len(list(tmp_path.iterdir())) == 2
    write_json(tmp_path / "a.json", 1)
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", other.name}


def _killed_while_writing(path: Path) -> None:
    with replacing(path) as partial:
        partial.write_text("half of")
        os.kill(os.getpid(), signal.SIGKILL)


def _make(path: Path) -> None:
    def slowly() -> None:
        with replacing(path) as partial:
            time.sleep(0.5)
            partial.write_text("made")
        with (path.parent / "count").open("a") as file:
            file.write("x")

    once(path, slowly, Path.read_text)


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
        once(tmp_path / "thing", fail, read_json)
    assert once(tmp_path / "thing", lambda: write_json(tmp_path / "thing", 1), read_json) == (1, True)


@pytest.mark.parametrize("left", [b"", b'{"kept": [1, 2', b"\xff\x00" * 20])
def test_a_damaged_file_of_the_cache_is_made_again(tmp_path: Path, left: bytes, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "thing"
    path.write_bytes(left)
    assert once(path, lambda: write_json(path, {"kept": 1}), read_json) == ({"kept": 1}, True)
    assert f"{path} is damaged, and is made again" in caplog.text
    assert once(path, lambda: pytest.fail("it is there"), read_json) == ({"kept": 1}, False)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_arrays_that_were_cut_short_are_damaged(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.npz"
    write_arrays(path, {"a": np.arange(1000), "b": np.ones((3, 3))})
    whole = path.read_bytes()
    assert read_arrays(path, ("a", "b"))["b"].sum() == 9
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(DamagedFile, match=r"is damaged .*: delete it and type the same command again"):
        read_arrays(path, ("a", "b"))


def test_a_write_that_finds_no_room_names_the_file_and_the_mend(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "result.json"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with (
        pytest.raises(StorageError, match=r"result\.json cannot be written \(No space left on device\): free some space"),
        storage_errors(),
    ):
        fail()
    with pytest.raises(FileNotFoundError), storage_errors():
        (tmp_path / "missing").read_text()


def _lives_on(pids: Path, marker: Path) -> None:
    end_with_parent()
    pids.write_text(str(os.getpid()))
    time.sleep(60)
    marker.touch()


def _parent(pids: Path, marker: Path) -> None:
    multiprocessing.get_context("spawn").Process(target=_lives_on, args=(pids, marker)).start()
    time.sleep(60)


def test_a_worker_ends_when_the_process_that_started_it_is_killed(tmp_path: Path) -> None:
    pids = tmp_path / "pid"
    parent = multiprocessing.get_context("spawn").Process(target=_parent, args=(pids, tmp_path / "marker"))
    parent.start()
    deadline = time.monotonic() + 60
    while not (pids.exists() and pids.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    parent.kill()
    parent.join()
    while Path(f"/proc/{pids.read_text()}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert not (tmp_path / "marker").exists()


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
