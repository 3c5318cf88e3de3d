"""The figure of one scene through all source models: what it refuses before it learns, and what it takes from a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from see2act.commands.heatmaps import _of_run, main
from see2act.experiment.config import composed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scenes", "0"], "--scenes 0 is too small"),
        (["--tasks", "edge,edges"], "edges.*choose from the options of .*corner"),
        (["task=edge"], "task=edge has no effect here: use --tasks"),
        (["transfer=backbone"], "transfer=backbone has no effect here"),
        (["--out", __file__], "cannot be written"),
        (["primitive=push"], "push"),
        (["objects=folder", "--tasks", "edge", "primitive=grasp"], "objects.path"),
        (["--run", "nowhere"], "--run takes the folder of a finished run"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=words) as told:
        main([f"paths.cache={tmp_path / 'cache'}", *([] if "--out" in arguments else ["--out", str(tmp_path)]), *arguments])
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


def test_a_run_says_what_it_was_typed_with(tmp_path: Path) -> None:
    folder = tmp_path / "of a user" / "conf" / "objects"
    folder.mkdir(parents=True)
    (folder / "tins.yaml").write_text("defaults: [diverse]\nname: tins\n")
    (tmp_path / ".hydra").mkdir()
    typed = ["task=edge", "transfer=full", "objects=tins", "seed=4", "finetune.attempts=${primitive.benchmark_attempts}"]
    OmegaConf.save(OmegaConf.create(typed), tmp_path / ".hydra" / "overrides.yaml")
    places = [f"file://{folder.parent}"]
    OmegaConf.save(OmegaConf.create({"hydra": {"searchpath": places}}), tmp_path / ".hydra" / "hydra.yaml")
    assert "seed=4" in _of_run(tmp_path, [])
    assert "seed=4" not in _of_run(tmp_path, ["seed=5"])
    elsewhere = "hydra.searchpath=[elsewhere]"
    assert not any("searchpath" in override for override in _of_run(tmp_path, [elsewhere]))
    cfg = composed([*_of_run(tmp_path, ["seed=5"]), "seed=5", "task=none", "transfer=none"])
    assert (cfg.objects.name, cfg.seed, cfg.finetune.attempts) == ("tins", 5, cfg.primitive.benchmark_attempts)
