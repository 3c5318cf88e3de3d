from __future__ import annotations

from pathlib import Path

import pytest
import torch

from see2act.errors import DamagedFile
from see2act.experiment.checkpoints import load_checkpoint, save_checkpoint


class Touch:
    """Unpickling it makes a file."""

    def __init__(self, marker: Path):
        self._marker = marker

    def __reduce__(self) -> tuple:
        return Path.touch, (self._marker,)


def test_a_checkpoint_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "vision.ckpt"
    save_checkpoint(path, {"task": "edge", "network": {"w": torch.arange(3.0)}})
    content = load_checkpoint(path, ("task", "network"))
    assert content["task"] == "edge"
    assert torch.equal(content["network"]["w"], torch.arange(3.0))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 0.999])
def test_a_checkpoint_that_was_cut_short_is_damaged(tmp_path: Path, share: float) -> None:
    path = tmp_path / "vision.ckpt"
    save_checkpoint(path, {"network": {"w": torch.arange(3000.0)}})
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(DamagedFile, match=r"^\S+vision\.ckpt is damaged \(.+\): delete it and type the same command again$"):
        load_checkpoint(path, ("network",))


def test_a_checkpoint_without_its_keys_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "vision.ckpt"
    save_checkpoint(path, {"network": {}})
    with pytest.raises(DamagedFile, match="it lacks state_dict"):
        load_checkpoint(path, ("state_dict",))
    torch.save([1, 2], path)
    with pytest.raises(DamagedFile, match="it lacks network"):
        load_checkpoint(path, ("network",))


def test_a_checkpoint_that_would_execute_code_does_not(tmp_path: Path) -> None:
    path, marker = tmp_path / "last.ckpt", tmp_path / "marker"
    torch.save({"state_dict": {}, "more": Touch(marker)}, path)
    with pytest.raises(DamagedFile, match="is damaged"):
        load_checkpoint(path, ("state_dict",))
    assert not marker.exists()
    torch.load(path, weights_only=False)
    assert marker.exists(), "the file would not have done anything"
