"""Runs of a robot whose bin a person fills: as few fillings as there can be, each said beforehand, and nothing lost."""

from __future__ import annotations

import json
import logging
from collections import Counter
from pathlib import Path

import pytest
from omegaconf import DictConfig

from see2act.analysis.groups import find
from see2act.errors import ConfigError
from see2act.experiment import attempts
from see2act.experiment.checks import validate
from see2act.experiment.context import RunContext
from see2act.experiment.folder import half_of_another_version
from see2act.experiment.identity import versions
from see2act.experiment.refills import refills
from see2act.experiment.results import RunResult, read_result
from see2act.experiment.single import run_checked
from see2act.experiment.stages.collect import collected, collection_key, held_out
from tests.attended import Killed, Table, configured

BASELINE = ("task=none", "transfer=none", "collect.interactions=4")


@pytest.fixture(autouse=True)
def _prepare() -> None:
    Table.prepare()


def made(folder: Path, *overrides: str) -> DictConfig:
    return configured(f"collect.folder={folder}/observations", f"paths.cache={folder}/cache", *overrides)


def run(folder: Path, *overrides: str) -> RunResult:
    (folder / "run").mkdir(exist_ok=True)
    run_checked(made(folder, *overrides), folder / "run")
    return read_result(folder / "run" / "result.json")


def test_the_bin_is_filled_as_often_as_was_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """A vision task, with one evaluation: after the last attempt, with the run's own policy."""
    with caplog.at_level(logging.INFO):
        numbers = ("collect.interactions=10", "finetune.attempts=4", "finetune.episode_attempts=3")
        result = run(tmp_path, "task=foreground", "transfer=full", *numbers)
    told = "fillings of the bin by hand: 3 to collect observations, at least 2 to learn, 2 to evaluate"
    assert caplog.messages[0] == told
    assert (Table.count("fill seen"), Table.count("fill unseen")) == (3 + 2 + 1, 1)
    assert (result.zero_shot, result.eval_argmax, [point.step for point in result.evals]) == (None, None, [4])
    rows = attempts.read(tmp_path / "run" / "attempts.csv")
    tested = result.eval.seen.attempts + result.eval.unseen.attempts
    assert Counter(row.phase for row in rows) == {"finetune": 4, "eval": tested}
    assert {row.policy for row in rows} == {"suppress"}
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("│")[2].strip() for line in lines if "zero-shot" in line or "argmax" in line] == ["-", "-"]
    pictures = {path.name for path in (tmp_path / "run" / "figures").iterdir()}
    assert pictures >= {"learning_curve.png", "diagnosis.png", "labels.png", "vision.png", "heatmaps.png", "picks.png"}


def test_further_evaluations_are_for_the_asking(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        result = run(tmp_path, *BASELINE, "finetune.attempts=2", "evaluate.at=[0,1,9]", "evaluate.argmax=true")
    assert "8 to evaluate" in caplog.messages[0]
    assert Table.count("fill unseen") == 4
    assert result.zero_shot is not None
    assert result.eval_argmax is not None
    assert [point.step for point in result.evals] == [0, 1, 2]


def test_what_is_never_fine_tuned_is_evaluated_once(tmp_path: Path) -> None:
    result = run(tmp_path, *BASELINE, "finetune.attempts=0")
    assert Table.count("fill unseen") == 1
    assert result.zero_shot is not None
    assert result.eval.repeated
    assert (tmp_path / "run" / "figures" / "heatmaps.png").exists()


def test_a_run_that_goes_on_says_what_is_left(tmp_path: Path) -> None:
    cfg = made(tmp_path, *BASELINE, "finetune.attempts=10", "finetune.episode_attempts=4", "evaluate.runs=3")
    (tmp_path / "run").mkdir()
    assert refills(RunContext(cfg, tmp_path / "run"), 0) == "fillings of the bin by hand: at least 3 to learn, 6 to evaluate"
    Table.killed_in = 4 + 5
    with pytest.raises(Killed):
        run_checked(cfg, tmp_path / "run")
    rows = [row for row in attempts.read(tmp_path / "run" / "attempts.csv") if row.phase == "finetune"]
    assert len(rows) == 5
    Table.blocks.clear()
    assert "at least 1 to learn" in refills(RunContext(cfg, tmp_path / "run"), 0), "3 in the scene under way, and 2"


def test_what_a_simulated_robot_does_stays_the_default() -> None:
    from see2act.experiment.config import composed

    simulated, real = composed(["precision=fp32"]), configured(*BASELINE)
    assert (list(simulated.evaluate.at), simulated.evaluate.argmax, simulated.collect.folder) == ([0, 60, 150, 300], True, None)
    assert (list(real.evaluate.at), real.evaluate.argmax, real.collect.folder) == ([], False, "observations")
    validate(real)
    with pytest.raises(ConfigError, match=r"collect\.folder=x is for a robot whose bin a person fills"):
        validate(composed(["precision=fp32", "collect.folder=x"]))


def test_vision_models_are_judged_by_what_was_kept_out_of_training(tmp_path: Path) -> None:
    cfg = made(tmp_path, "task=foreground", "transfer=full", "pretrain.validation=0.2", "pretrain.test_scenes=100")
    collection = collected(cfg)
    fillings = Table.count("fill")
    scenes = held_out(cfg)
    assert Table.count("fill") == fillings
    assert len(scenes) == 2
    assert (scenes.arrays["height"] == collection.arrays["height"][-2:]).all()


def test_a_vision_model_depends_on_what_was_observed_and_not_on_the_robot_s_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cfg = made(tmp_path, "task=foreground", "transfer=full")
    collected(cfg)
    monkeypatch.setattr("see2act.experiment.stages.collect.code_hash", None)
    monkeypatch.setattr("see2act.experiment.stages.collect.packages", None)
    key = collection_key(cfg)
    folder = tmp_path / "observations"
    folder.rename(tmp_path / "moved")
    assert collection_key(made(tmp_path, f"collect.folder={tmp_path}/moved")) == key
    (tmp_path / "moved" / "scene-00000-000.npz").write_bytes((tmp_path / "moved" / "scene-00000-001.npz").read_bytes())
    assert collection_key(made(tmp_path, f"collect.folder={tmp_path}/moved")) != key


def test_observations_of_another_grid_are_refused_before_work(tmp_path: Path) -> None:
    collected(made(tmp_path, "collect.interactions=1"))
    with pytest.raises(ConfigError, match=r"holds observations with workspace\.width=0\.12"):
        run(tmp_path, *BASELINE, "workspace.width=0.16")
    assert not (tmp_path / "run" / "run.json").exists()
    assert json.loads((tmp_path / "observations" / "grid.json").read_text())["primitive"] == "suction"


def test_another_version_goes_on_with_a_warning_and_both_are_recorded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Attempts of a real robot cannot be made again; another configuration is refused as ever."""
    overrides = (*BASELINE, "finetune.attempts=3")
    Table.killed_in = 4 + 2
    with pytest.raises(Killed):
        run(tmp_path, *overrides)
    note = tmp_path / "run" / "run.json"
    began = json.loads(note.read_text())
    began["versions"]["code"] = "of yesterday"
    note.write_text(json.dumps(began))
    Table.killed_in = -1
    with pytest.raises(ConfigError, match="holds a run of another configuration"):
        run(tmp_path, *overrides, "finetune.updates=3")
    assert not half_of_another_version(tmp_path / "run", made(tmp_path, *overrides))
    with caplog.at_level(logging.WARNING):
        result = run(tmp_path, *overrides)
    (warning,) = caplog.messages
    assert "another version began this run" in warning
    assert "code of yesterday -> " in warning
    assert result.earlier_versions == (began["versions"],)
    assert result.versions == versions()
    assert Table.count("pick") == 4 + 3 + result.eval.seen.attempts + result.eval.unseen.attempts
    (notice,) = find(tmp_path).notices[:1]
    assert "was begun by another version" in notice


@pytest.mark.parametrize("as_it_was", [True, False])
def test_an_evaluation_goes_on_with_what_failed_in_mind(tmp_path: Path, as_it_was: bool) -> None:
    overrides = (*BASELINE, "finetune.attempts=0", "evaluate.attempts.seen=6")
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    Table.slippery = True
    run(tmp_path / "whole", *overrides)
    Table.killed_in = 4 + 3
    with pytest.raises(Killed):
        run(tmp_path / "killed", *overrides)
    Table.killed_in, Table.as_it_was = -1, as_it_was
    asked = len(Table.calls)
    run(tmp_path / "killed", *overrides)
    assert Table.calls[asked] == "resume after 3"
    assert ("fill seen" in Table.calls[asked:]) != as_it_was
    whole, killed = (attempts.read(tmp_path / name / "run" / "attempts.csv") for name in ("whole", "killed"))
    places = [[(row.row, row.col) for row in rows if row.split == "seen"] for rows in (whole, killed)]
    if as_it_was:
        assert places[1] == places[0]
        assert len(set(places[1])) == 6, "each place is tried once"
    else:
        assert places[1] == places[0][:3] * 2, "a new scene is begun with an empty memory"
