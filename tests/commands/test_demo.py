"""The robot clears a bin for whoever watches."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
import torch
from hydra.utils import instantiate

from see2act.commands.demo import MODELS, clear, main
from see2act.errors import ConfigError
from see2act.experiment import model_file
from see2act.experiment.config import composed

FEW = ("objects.kinds=1", "objects.copies=2", "seed=2")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cfg = composed(["model.width=4", "primitive=suction"])
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("models") / model_file.FILE
    model_file.save(path, instantiate(cfg.model.network), cfg)
    return path


def test_it_tries_until_the_bin_is_empty_and_leaves_pictures(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    few = "evaluate.attempts.unseen=4"
    main(["primitive=suction", "--checkpoint", str(model), "--out", str(tmp_path), *FEW, "--no-film", few])
    told = capsys.readouterr().out
    tried = told.count("score")
    assert 2 <= tried <= 4
    assert f"of {tried} picks succeeded" in told
    assert tried == 4 or "the bin is empty" in told
    folder = tmp_path / "suction-diverse-seed2"
    assert cv2.imread(str(folder / "strip.png")).shape[0] > 400
    assert not (folder / "clearing.mp4").exists()


@pytest.mark.slow
def test_the_film_can_be_played(model: Path, tmp_path: Path) -> None:
    few = ("objects.kinds=1", "objects.copies=1", "evaluate.attempts.unseen=2")
    clear([*few, "primitive=suction"], model, tmp_path, film=True)
    film = cv2.VideoCapture(str(tmp_path / "suction-diverse-seed0" / "clearing.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 15
    assert film.read()[0]
    shutil.rmtree(tmp_path)


def test_what_does_not_fit_is_refused(model: Path, tmp_path: Path) -> None:
    with pytest.raises(model_file.ModelFileError, match="trained for primitive=suction, not grasp"):
        clear(["primitive=grasp"], model, tmp_path, film=False)
    with pytest.raises(ConfigError, match=r"the model learned from 0\.0025"):
        clear(["primitive=suction", "workspace=suction_real"], model, tmp_path, film=False)
    with pytest.raises(SystemExit, match="is not there"):
        main(["--checkpoint", str(tmp_path / "none.safetensors"), "--out", str(tmp_path)])
    with pytest.raises(ConfigError, match="did not learn with this end effector"):
        clear(["primitive=grasp_rg2"], None, tmp_path, film=False)
    with pytest.raises(ConfigError, match="did not learn with this end effector"):
        clear(["primitive=suction", "primitive.end_effector.cup_radius=0.012"], model, tmp_path, film=False)
    for overrides in (["primitive=foo"], ["nonsense"], ["seed=x"], ["objects=folder"], ["objects.scale=[2,3]"]):
        with pytest.raises(SystemExit, match="see2act: ") as told:
            main([*overrides, "--checkpoint", str(model), "--out", str(tmp_path)])
        assert "\n" not in str(told.value)
    with pytest.raises(SystemExit, match="cannot be written"):
        main(["primitive=suction", "--checkpoint", str(model), "--out", str(model)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("primitive", ["suction", "grasp"])
def test_the_models_that_are_shipped_clear_most_of_a_bin(primitive: str, tmp_path: Path) -> None:
    """As any run's file, with the configuration that made it; and they pick."""
    shipped = model_file.load(MODELS / f"{primitive}.safetensors", primitive)
    assert shipped.config_hash in (MODELS / "README.md").read_text()
    picked, tried = clear([f"primitive={primitive}"], None, tmp_path, film=False)
    assert picked >= 6
    assert tried <= 15
