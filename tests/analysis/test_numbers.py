"""What is concluded from numbers, and where they are taken from."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torchvision
from omegaconf import DictConfig

from see2act.analysis import paper, runs
from see2act.analysis.contrasts import aggregates, contrasts, verdict
from see2act.analysis.groups import SHOWN, find
from see2act.analysis.plots import _blocks, _failures
from see2act.analysis.reaching import Reaching, reaching
from see2act.analysis.runs import CONDITIONS
from see2act.analysis.summary import progress, rows
from see2act.experiment.results import wilson
from see2act.modules.nanodet_weights import FILE as NANODET
from see2act.seeding import generator

MakeRun = Callable[..., Path]


@pytest.mark.parametrize(
    ("n", "m", "improvement", "difference", "words"),
    [
        (
            2,
            20,
            (1.0, 1.0),
            (0.1, 0.3),
            "too few seeds to conclude (2 and 20): equal groups would separate completely one time in 116",
        ),
        (3, 3, (1.0, 1.0), (0.1, 0.3), "equal groups would separate completely one time in 10"),
        (1, 1, (1.0, 1.0), (0.1, 0.3), "equal groups would separate completely always"),
        (4, 4, (0.6, 1.0), (0.1, 0.3), "better"),
        (5, 5, (0.0, 0.4), (-0.3, -0.1), "worse"),
        (5, 5, (0.4, 1.0), (0.1, 0.3), "no significant difference"),
        (5, 5, (0.5, 1.0), (0.1, 0.3), "no significant difference"),
        (5, 5, (0.0, 0.24), (-0.216, 0.004), "no significant difference"),
        (5, 5, (0.6, 1.0), (0.0, 0.3), "no significant difference"),
    ],
)
def test_nothing_is_concluded_from_too_little(
    n: int, m: int, improvement: tuple[float, float], difference: tuple[float, float], words: str
) -> None:
    assert words in verdict(n, m, improvement, difference)


def test_seeds_that_repeat_each_other_are_one_measurement(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in range(5):
        make_run("normal-full", seed=seed, zero=[(3, 10), (4, 10)], unseen=[(seed, 10), (5, 10)])
        make_run("normal-backbone", seed=seed, zero=[(3, 10), (4, 10)])
        make_run("normal-fixed", seed=seed, learned=[], primitive__attempts=40)
    by_cell = {(r["task"], r["transfer"]): r for r in rows(find(tmp_path)) if r["primitive"] == "suction"}
    full = by_cell["normal", "full"]
    assert (full["zero_shot_unseen_successes"], full["zero_shot_unseen_attempts"]) == ("7", "20")
    assert (full["zero_shot_unseen_low"], full["after_unseen_attempts"]) == ("", "100")
    assert full["zero_shot_unseen_wilson_low"] == f"{wilson(7, 20)[0]:.3f}"
    assert full["gain_unseen_lowest"] == "-0.100"
    assert by_cell["normal", "backbone"]["zero_shot_unseen_attempts"] == "100"  # its head is each seed's own
    assert by_cell["normal", "fixed"]["after_unseen_attempts"] == "20"
    (comparison,) = find(tmp_path).comparisons
    against = {(c.group.condition, c.other.condition): c for c in contrasts(comparison, "after_unseen")}
    assert "too few seeds to conclude (1 and 5)" in against["normal, fixed", "normal, full"].verdict
    (point,) = (p for p in progress(comparison) if (p["transfer"], p["step"], p["split"]) == ("full", "0", "unseen"))
    assert point["attempts"] == "20"


def test_one_model_that_is_off_by_an_attempt_on_another_processor_is_still_one_measurement(
    make_run: MakeRun, tmp_path: Path
) -> None:
    for seed in range(5):
        make_run("normal-full", seed=seed, zero=[(3, 10), (4, 11 if seed == 2 else 10)])
    (row,) = [r for r in rows(find(tmp_path)) if (r["primitive"], r["task"]) == ("suction", "normal") and r["seeds"]]
    assert (row["zero_shot_unseen_attempts"], row["zero_shot_unseen_low"]) == ("20", "")


def test_seeds_with_a_vision_model_each_do_not_repeat_each_other(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in range(5):
        make_run("corner-full", seed=seed, zero=[(0, 10), (0, 10)], pretrain__seed="${seed}")
        make_run("edge-full", seed=seed, zero=[(0, 10), (0, 10)], pretrain__seed=0)
    found = find(tmp_path)
    by_cell = {(r["task"], r["transfer"]): r for r in rows(found) if r["primitive"] == "suction"}
    assert by_cell["corner", "full"]["zero_shot_unseen_attempts"] == "100"
    assert by_cell["edge", "full"]["zero_shot_unseen_attempts"] == "20"
    (notice,) = [notice for notice in found.notices if "share vision models" in notice]
    assert "edge, full" in notice
    assert "corner" not in notice


def test_groups_are_compared_with_the_baseline_and_within_their_source(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in range(4):
        make_run("none-none", seed=seed, unseen=[(seed, 10), (seed, 10)])
        make_run("normal-full", seed=seed, unseen=[(5 + seed, 10), (5 + seed, 10)])
        make_run("normal-backbone", seed=seed, unseen=[(seed, 10), (seed, 10)])
        make_run("edge-full", seed=seed)
        make_run("edge-full", "grasp", seed=seed)
    comparison = next(comparison for comparison in find(tmp_path).comparisons if comparison.primitive == "suction")
    found = {(c.group.condition, c.other.condition): c for c in contrasts(comparison, "after_unseen")}
    assert set(found) == {
        ("normal, full", "none (random)"),
        ("normal, backbone", "none (random)"),
        ("normal, backbone", "normal, full"),
        ("edge, full", "none (random)"),
    }
    assert (found["normal, full", "none (random)"].probability, found["normal, full", "none (random)"].verdict) == (
        "1.000",
        "better",
    )
    gap = found["normal, full", "none (random)"]
    assert (gap.difference, gap.difference_low, gap.difference_high) == ("0.500", "0.277", "0.723")  # 0.5 +- 2.447 * 0.0913
    assert found["normal, backbone", "none (random)"].probability == "0.500"
    assert found["normal, backbone", "normal, full"].verdict == "worse"
    together = aggregates(comparison)
    assert [(a.transfer, a.sources) for a in together] == [("none", "none"), ("full", "normal, edge"), ("backbone", "normal")]
    assert [a.mean for a in together] == ["0.150", "0.725", "0.150"]  # 0.725: of six times 0.7 and two 0.8


def test_sources_with_several_configurations_are_not_put_together(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("normal-full", config_hash="aaaaaaaaaaaa")
    make_run("normal-full", config_hash="bbbbbbbbbbbb")
    make_run("edge-full", config_hash="cccccccccccc")
    (comparison,) = find(tmp_path).comparisons
    assert aggregates(comparison) == []


def test_attempts_until_the_target_are_those_of_the_first_test_that_shows_it(make_run: MakeRun, tmp_path: Path) -> None:
    good, bad, enough = [(9, 10), (9, 10)], [(5, 10), (6, 10)], [(8, 10), (8, 10)]
    for seed in range(10):  # two seeds after 10 attempts, six after 20, one after all 40, and one never
        early, late = (good if seed < 2 else bad), (bad if seed < 2 else enough if seed < 8 else bad)
        last = bad if seed == 9 else good
        make_run("edge-full", seed=seed, zero=bad, unseen=last, between={10: early, 20: late}, pretrain__seed="${seed}")
        make_run("normal-full", seed=seed, zero=enough, unseen=bad, between={10: bad, 20: bad}, pretrain__seed="${seed}")
        if seed < 5:
            make_run("corner-full", seed=seed, zero=bad, unseen=bad, between={10: bad, 20: bad}, pretrain__seed="${seed}")
            make_run("center-fixed", seed=seed, zero=good, learned=[], primitive__attempts=40)
    (comparison,) = find(tmp_path).comparisons
    found = {group.condition: reaching(group) for group in comparison.groups}
    edge, normal, corner = (found[f"{task}, full"] for task in ("edge", "normal", "corner"))
    assert edge is not None
    assert normal is not None
    assert corner is not None
    assert edge.each == (10, 10, 20, 20, 20, 20, 20, 20, 40, math.inf)
    assert (edge.median, edge.interval, edge.reached) == (20, (10, 40), 9)  # the second and the ninth of ten
    assert (normal.median, normal.reached) == (0, 10)
    assert (corner.text(corner.median), corner.interval, corner.reached) == ("> 40", None, 0)
    assert found["center, fixed"] is None
    by_task = {row["task"]: row for row in rows(find(tmp_path)) if row["primitive"] == "suction"}
    reach = {task: [by_task[task][f"reach_{part}"] for part in ("median", "low", "high", "seeds")] for task in by_task}
    assert reach["edge"] == ["20", "10", "40", "9"]
    assert reach["corner"] == ["> 40", "", "", "0"]
    assert reach["center"] == ["", "", "", ""]


def test_the_interval_of_a_median_contains_it_as_often_as_it_says() -> None:
    rng = generator("test")
    draws = rng.exponential(50, size=(400, 10))
    draws[draws > 100] = math.inf  # not reached
    limits = [Reaching(tuple(draw), 100).interval for draw in draws]
    contained = np.mean([low <= 50 * math.log(2) <= high for low, high in filter(None, limits)])
    assert len(limits) == 400
    assert contained == pytest.approx(0.979, abs=0.02)  # of the second and ninth of ten: 1 - 2 * 11 / 2**10


def test_robot_minutes_add_up_and_failures_are_shares(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in range(2):
        make_run(seed=seed, learned=[1] * 20 + [0] * 20 + [1] * 5, seen=[(10, 10)], unseen=[(0, 10)], zero=[(5, 10)])
    ((group,),) = (comparison.groups for comparison in find(tmp_path).comparisons)
    blocks = _blocks(group)
    assert blocks.steps.tolist() == [20, 40, 45]
    assert blocks.rates.tolist() == [[1, 0, 1]] * 2
    assert blocks.minutes[0] == pytest.approx([2, 4, 4.5])  # six seconds an attempt
    assert _failures(group, "while learning") == {"slipped": pytest.approx(20 / 45)}
    assert _failures(group, "zero-shot") == {"missed": 0.5}
    assert _failures(group, "after, by the protocol") == {"missed": 0.5}


def test_the_file_names_of_weights_are_those_that_are_read(config: Callable[..., DictConfig]) -> None:
    for (model, task), file in paper.OFF_THE_SHELF.items():
        shelf = config(f"task={task}", "transfer=backbone", f"model={model}").task.off_the_shelf[model]
        if model == "nanodet_g":
            assert file == NANODET.name
            continue
        name, member = shelf.weights.split(".")
        assert torchvision.models.get_model_weights(name)[member].url.endswith(f"/{file}")


def test_weights_of_make_coco_are_missed_and_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEE2ACT_CACHE", str(tmp_path))
    assert paper.missing_weights("coco", "nanodet_g") == NANODET.name
    (tmp_path / NANODET).parent.mkdir()
    (tmp_path / NANODET).touch()
    assert paper.missing_weights("coco", "nanodet_g") is None
    assert paper.missing_weights("coco", "fcn7") is None


def test_the_keys_of_a_setting_are_those_of_the_configuration(config: Callable[..., DictConfig]) -> None:
    flat = runs._flat(config())
    for key in SHOWN:
        assert key in flat or f"{key}.name" in flat
    for beginning in CONDITIONS:
        assert any(runs.begins(key, [beginning]) for key in flat), beginning
    assert runs.begins("evaluate.attempts.seen", CONDITIONS)
    assert not runs.begins("evaluate.at", CONDITIONS)
