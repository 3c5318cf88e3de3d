"""The command, on runs whose numbers are known."""

from __future__ import annotations

import csv
import gzip
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import pytest
from scipy.stats import t

from see2act.analysis import plots
from see2act.analysis.commands import command
from see2act.commands.report import main, report
from see2act.errors import UserError
from see2act.experiment.results import wilson
from see2act.experiment.sweep import link

MakeRun = Callable[..., Path]
VOID = {"meta", "link", "img", "br", "hr"}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take seconds, which tests of numbers need not wait for."""
    monkeypatch.setattr(plots, "FIGURES", ())


def _table(folder: Path) -> list[dict[str, str]]:
    with (folder / "table.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _row(folder: Path, task: str, transfer: str, primitive: str = "suction") -> dict[str, str]:
    rows = [r for r in _table(folder) if (r["task"], r["transfer"], r["primitive"]) == (task, transfer, primitive)]
    assert len(rows) == 1
    return rows[0]


class Page(HTMLParser):
    """Reads a report: whether tags close, its pictures and links, and the numbers of its tables by row."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.links: list[tuple[str, str]] = []
        self.cells: dict[int, dict[str, str]] = {}
        self.ids: list[str] = []
        self._row: int | None = None
        self._column: str | None = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            self.images.append(values)
        if tag == "tr" and values.get("data-row"):
            self._row = int(str(values["data-row"]))
        self._column = values.get("data-column") or self._column
        self.ids += [str(values["id"])] if "id" in values else []
        self.links += [(tag, str(values[key])) for key in ("href", "src") if values.get(key)]

    def handle_data(self, data: str) -> None:
        if self._column and self._row is not None:
            self.cells.setdefault(self._row, {})[self._column] = data

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        if tag == "span":
            self._column = None
        if tag == "tr":
            self._row = None


@pytest.mark.usefixtures("no_figures")
def test_the_table_holds_what_one_computes_by_hand(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0, unseen=[(7, 10), (10, 10)], learned=[1] * 10 + [0] * 30)
    make_run(seed=1, unseen=[(6, 10), (9, 15)], learned=[1] * 20 + [0] * 20)
    make_run(seed=2, unseen=[(3, 4), (3, 4)], learned=[1] * 30 + [0] * 10)
    report(runs)
    row = _row(runs, "normal", "full")
    assert (row["seeds"], row["paper_unseen"], row["config_hash"]) == ("0 1 2", "1.00", "aaaaaaaaaaaa")
    assert row["after_unseen_mean"] == "0.733"  # of 0.85, 0.6 and 0.75
    low, high = t.interval(0.95, 2, loc=2.2 / 3, scale=0.1258306 / 3**0.5)
    assert (row["after_unseen_low"], row["after_unseen_high"]) == (f"{low:.3f}", "1.000")
    assert high > 1  # and cut
    assert (row["after_unseen_successes"], row["after_unseen_attempts"]) == ("38", "53")
    assert [row["after_unseen_wilson_low"], row["after_unseen_wilson_high"]] == [f"{x:.3f}" for x in wilson(38, 53)]
    assert row["after_unseen_iqm"] == "0.700"  # of 0.6, 0.7, 0.75 and 0.75: 0.6 and 1 are cut
    assert (row["zero_shot_seen_mean"], row["zero_shot_seen_low"]) == ("0.350", "")  # three times the same model
    assert (row["learning_mean"], row["learning_successes"], row["learning_attempts"]) == ("0.500", "60", "120")
    assert (row["argmax_seen_mean"], row["argmax_seen_attempts"]) == ("0.350", "60")
    assert (row["gain_unseen_mean"], row["gain_unseen_lowest"]) == ("0.383", "0.250")  # of 0.5, 0.25 and 0.4
    low, high = t.interval(0.95, 2, loc=1.15 / 3, scale=0.1258306 / 3**0.5)
    assert (row["gain_unseen_low"], row["gain_unseen_high"]) == (f"{low:.3f}", f"{high:.3f}")


@pytest.mark.usefixtures("no_figures")
def test_success_on_the_way_is_given_where_every_seed_has_it(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0)
    folder = make_run(seed=1, unseen=[(3, 10), (2, 10)])
    result = json.loads((folder / "result.json").read_text())
    result["evals"].insert(1, {**result["evals"][0], "step": 20})
    (folder / "result.json").write_text(json.dumps(result))
    report(runs)
    with (runs / "progress.csv").open(newline="") as file:
        rows = {(row["step"], row["split"]): row for row in csv.DictReader(file)}
    assert set(rows) == {(step, split) for step in ("0", "40") for split in ("seen", "unseen")}
    last = rows["40", "unseen"]
    assert (last["seeds"], last["mean"], last["successes"], last["attempts"]) == ("0 1", "0.550", "22", "40")
    page = (runs / "report.html").read_text()
    table = page[page.index('<table class="progress">') :]
    assert "<b>0.550</b>" in table[: table.index("</table>")]
    assert "<small>least -0.100</small>" in table[: table.index("</table>")]


@pytest.mark.usefixtures("no_figures")
def test_nothing_is_said_to_be_gained_where_nothing_was_learned(make_run: MakeRun, runs: Path) -> None:
    make_run(learned=[])
    report(runs)
    assert _row(runs, "normal", "full")["gain_unseen_mean"] == ""


def test_what_was_evaluated_at_the_end_alone_has_a_dash_for_the_rest(make_run: MakeRun, runs: Path) -> None:
    """As a robot whose bin a person fills is."""
    for seed in (0, 1):
        path = make_run(seed=seed, pictures=True) / "result.json"
        result = json.loads(path.read_text())
        result |= {"zero_shot": None, "evals": result["evals"][1:]}
        del result["eval_argmax"]
        path.write_text(json.dumps(result))
    report(runs)
    row = _row(runs, "normal", "full")
    assert (row["after_unseen_mean"], row["seeds"]) == ("0.850", "0 1")
    missing = ("zero_shot_unseen_mean", "zero_shot_seen_attempts", "argmax_seen_mean", "gain_unseen_mean", "gain_seen_lowest")
    assert [row[column] for column in missing] == [""] * len(missing)
    assert {path.stem for path in (runs / "figures").glob("*.png")} == {
        "curves-suction",
        "protocol-suction",
        "reach-suction",
        "transfer-suction",
        "causes-suction",
    }
    page = (runs / "report.html").read_text()
    assert not re.search(r"\bnan\b", page)
    assert page.count('<span class="faint">\N{EN DASH}</span>') >= 4
    assert "after fine-tuning 17/20 seen, 17/20 unseen." in page


@pytest.mark.usefixtures("no_figures")
def test_one_seed_has_no_interval(make_run: MakeRun, runs: Path) -> None:
    make_run()
    row = _row(report(runs) and runs, "normal", "full")
    assert (row["after_unseen_mean"], row["after_unseen_low"], row["after_unseen_high"]) == ("0.850", "", "")


@pytest.mark.usefixtures("no_figures")
def test_several_hashes_of_one_cell_are_kept_apart_and_said(
    make_run: MakeRun, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(config_hash="aaaaaaaaaaaa", unseen=[(10, 10), (10, 10)])
    make_run(config_hash="bbbbbbbbbbbb", unseen=[(0, 10), (0, 10)], finetune__logit_scale=1.0)
    main([str(runs)])
    rows = [row for row in _table(runs) if row["config_hash"]]
    assert [(row["after_unseen_mean"], row["differs"]) for row in rows] == [
        ("1.000", "finetune.logit_scale=0.25"),
        ("0.000", "finetune.logit_scale=1.0"),
    ]
    words = "normal, full was run with 2 configurations, a row each: aaaaaaaaaaaa (finetune.logit_scale=0.25)"
    assert words in capsys.readouterr().out
    page = (runs / "report.html").read_text()
    assert words in page
    assert "normal, full [aaaaaa]" in page


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"versions": {"python": "3.11.7", "see2act": "0.1.0", "numpy": "9.9.9"}}, "version of numpy=9.9.9"),
        ({"seen": [(5, 10)], "unseen": [(5, 10)], "zero": [(5, 10)]}, "evaluate.runs=1"),
        ({"evaluate__scenes": "develop"}, "evaluate.scenes=develop"),
        ({"evaluate__attempts__unseen": 3}, "evaluate.attempts.unseen=3"),
        ({"policy__radius": 9}, "policy.radius=9"),
        ({"learned": [1] * 60}, "finetune.attempts=60"),
    ],
)
def test_what_was_tested_otherwise_is_kept_apart_and_said(
    make_run: MakeRun, runs: Path, capsys: pytest.CaptureFixture[str], other: dict[str, object], words: str
) -> None:
    make_run("none-none", seed=0)
    make_run("none-none", seed=1)
    same_hash = "versions" in other  # of which alone the hash knows nothing
    make_run("none-none", seed=2, config_hash="aaaaaaaaaaaa" if same_hash else "bbbbbbbbbbbb", **other)
    main([str(runs)])
    rows = [row for row in _table(runs) if row["config_hash"]]
    assert [(row["protocol"], row["seeds"]) for row in rows] == [("1", "0 1"), ("2", "2")]
    out = capsys.readouterr().out
    assert "suction was tested by 2 protocols, which are kept apart" in out
    assert words in out
    assert words in (runs / "report.html").read_text()


@pytest.mark.usefixtures("no_figures")
def test_groups_that_differ_in_more_than_transfer_are_said(make_run: MakeRun, runs: Path) -> None:
    make_run("none-none", config_hash="aaaaaaaaaaaa")
    make_run("normal-full", config_hash="bbbbbbbbbbbb", finetune__logit_scale=1.0)
    notices = report(runs).notices
    assert any("groups differ in more than their source and transfer: finetune.logit_scale" in notice for notice in notices)


@pytest.mark.usefixtures("no_figures")
def test_groups_that_learn_at_other_rates_are_compared(make_run: MakeRun, runs: Path) -> None:
    make_run("none-none", config_hash="aaaaaaaaaaaa", model__rates__head=1e-4)
    make_run("normal-full", config_hash="bbbbbbbbbbbb", model__rates__head=3e-4)
    report(runs)
    assert [row["protocol"] for row in _table(runs) if row["config_hash"]] == ["", ""]


@pytest.mark.usefixtures("no_figures")
def test_a_run_that_is_there_twice_counts_once(make_run: MakeRun, runs: Path) -> None:
    make_run(unseen=[(5, 10), (5, 10)])
    make_run(unseen=[(9, 10), (9, 10)], name="seed0.20200101-000000")
    notices = report(runs).notices
    assert _row(runs, "normal", "full")["after_unseen_attempts"] == "20"
    assert _row(runs, "normal", "full")["after_unseen_mean"] == "0.500"
    assert any("twice, with OTHER numbers" in n and "seed0.20200101-000000 does not" in n for n in notices)


@pytest.mark.usefixtures("no_figures")
def test_runs_that_learned_otherwise_and_end_alike_do_not_have_the_same_numbers(make_run: MakeRun, runs: Path) -> None:
    make_run(learned=[True] * 40)
    make_run(learned=[False] * 40, name="seed0.20200101-000000")
    assert any("twice, with OTHER numbers" in notice for notice in report(runs).notices)


@pytest.mark.usefixtures("no_figures")
def test_a_run_that_two_sweeps_share_counts_once_and_without_ado(make_run: MakeRun, runs: Path) -> None:
    folder = make_run(pictures=True)
    other = runs / "another" / "seed0"
    shutil.copytree(folder / ".hydra", other / ".hydra")
    link(folder, other)
    assert not any("twice" in notice for notice in report(runs).notices)
    assert _row(runs, "normal", "full")["seeds"] == "0"
    assert [run.place for run in report(runs / "another").runs] == ["seed0"]


@pytest.mark.usefixtures("no_figures")
def test_unfinished_and_broken_runs_are_listed_and_not_counted(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0)
    make_run(seed=1, finished=False)
    make_run("edge-full", finished=False)
    half = make_run(seed=2)
    text = (half / "result.json").read_text()
    (half / "result.json").write_text(text[:200])
    wrong = make_run(seed=3)
    (wrong / "result.json").write_text(text.replace('"successes": 17', '"successes": 99', 1))
    missing = make_run(seed=4)
    (missing / "result.json").write_text("{}")
    begun = runs / "grasp" / "begun"
    begun.mkdir(parents=True)
    (begun / "run.json").write_text("{}")
    (runs / "grasp" / "left_out" / ".hydra").mkdir(parents=True)  # a sweep leaves such where a cell makes no sense
    found = report(runs)
    assert _row(runs, "normal", "full")["seeds"] == "0"
    reasons = dict(found.broken)
    assert "is damaged" in reasons[half.relative_to(runs).as_posix()]
    assert "choices: Field required" in reasons[missing.relative_to(runs).as_posix()]
    assert "99 successes of 20 attempts" in reasons[wrong.relative_to(runs).as_posix()]
    states = {u.place.split("/")[-1] + u.task: u.state for u in found.unfinished}
    assert states["seed1normal"] == "40 of 40 fine-tuning attempts done"
    assert states["begununknown"] == "stopped before its first attempt"
    assert len(states) == 3
    page = (runs / "report.html").read_text()
    for place in [*reasons, *(u.place for u in found.unfinished)]:
        assert place in page
    assert _row(runs, "edge", "full")["note"] == "only unfinished runs (1)"


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"rate": 0.85', '"rate": NaN', "rate nan is not 17/20"),
        ('"successes": 17, "attempts": 20', '"successes": 18, "attempts": 20', "test runs sum up to 17/20, not 18/20"),
        ('"seed": 0', '"seed": "0"', "seed 0 is no number"),
        ('"primitive": "suction"', '"primitive": "../suction"', "choices are no words"),
        ('"evals": [', '"evals": [], "old": [', "evals are missing"),
        ('"successes": 20,', '"successes": "20",', "seen.successes: Input should be a valid integer"),
        ('"successes": 10, "attempts": 20', '"successes": 21, "attempts": 20', "21 successes of 20 attempts"),
        ('"attempts": 20, "step": 20', '"attempts": 20, "step": "20"', "curve.0.step: Input should be a valid integer"),
        ('"attempts": 20, "step": 20', '"attempts": 20, "step": 30', "steps of its curve"),
        ('"step": 0}', '"step": "0"}', "evals.0.step: Input should be a valid integer"),
        ('"step": 0}', '"step": 50}', "evals are missing, or not in order"),
    ],
)
def test_an_impossible_result_is_left_out_with_the_reason(
    make_run: MakeRun, runs: Path, old: str, new: str, reason: str
) -> None:
    file = make_run(seen=[(10, 10), (10, 10)]) / "result.json"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    found = report(runs)
    assert not found.runs
    assert reason in found.broken[0][1]
    assert any("Left out" in notice and reason in notice for notice in found.notices)


@pytest.mark.usefixtures("no_figures")
def test_a_run_that_was_typed_with_an_interpolation_is_read(make_run: MakeRun, runs: Path) -> None:
    overrides = make_run() / ".hydra" / "overrides.yaml"
    overrides.write_text(overrides.read_text() + "- finetune.attempts=${primitive.benchmark_attempts}\n")
    (found,) = report(runs).runs
    assert "finetune.attempts=${primitive.benchmark_attempts}" in found.overrides


@pytest.mark.usefixtures("no_figures")
def test_every_group_of_the_paper_has_a_row(
    make_run: MakeRun, runs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    make_run()
    make_run(config_hash="bbbbbbbbbbbb", learned=[])
    report(runs)
    tasks = [row["task"] for row in _table(runs) if (row["primitive"], row["model"]) == ("suction", "fcn7")]
    assert tasks == ["none", "normal", "normal", "center", "corner", "edge", "foreground"]
    published = {row["config_hash"]: row["paper_unseen"] for row in _table(runs) if row["config_hash"]}
    assert published == {"aaaaaaaaaaaa": "1.00", "bbbbbbbbbbbb": ""}  # which never learned
    assert _row(runs, "center", "full")["note"] == "no runs"
    assert _row(runs, "center", "full")["paper_unseen"] == "0.83"
    assert _row(runs, "none", "none", "grasp")["paper_unseen"] == "0.71"
    assert _row(runs, "foreground", "backbone", "grasp")["paper_unseen"] == ""  # the paper does not say on which objects
    assert _row(runs, "imagenet", "backbone")["note"] == "no runs; weights not here: resnet50-0676ba61.pth"
    (tmp_path / "torch/hub/checkpoints").mkdir(parents=True)
    (tmp_path / "torch/hub/checkpoints/resnet50-0676ba61.pth").touch()
    report(runs)
    assert _row(runs, "imagenet", "backbone")["note"] == "no runs"


@pytest.mark.usefixtures("no_figures")
def test_a_group_whose_weights_are_not_here_has_its_command(
    make_run: MakeRun, runs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    for seed in (0, 1):
        make_run("none-none", "grasp", seed=seed, model="rpn_r50_fpn", experiment="off_the_shelf", workspace__pixel=0.0025)
    report(runs)
    note = _row(runs, "coco", "fixed", "grasp")["note"]
    assert note.startswith("no runs; weights not here: fasterrcnn_resnet50_fpn_coco-258fb6c6.pth, with which it is `")
    typed = "primitive=grasp threads=1 experiment=off_the_shelf workspace.pixel=0.0025 task=coco transfer=fixed seed=0,1"
    assert note.endswith(f"`python train.py -m {typed} task.weights=fasterrcnn_resnet50_fpn_coco-258fb6c6.pth`")
    assert note in (runs / "report.html").read_text()


@pytest.mark.usefixtures("no_figures")
def test_the_paper_s_numbers_stand_beside_its_own_simulation_only(make_run: MakeRun, runs: Path) -> None:
    make_run(model="rpn_r50_fpn")
    report(runs)
    rows = {row["model"]: row for row in _table(runs) if (row["primitive"], row["task"]) == ("suction", "normal")}
    assert (rows["rpn_r50_fpn"]["paper_unseen"], rows["fcn7"]["paper_unseen"]) == ("", "1.00")
    assert rows["fcn7"]["note"] == "no runs"


@pytest.mark.usefixtures("no_figures")
def test_a_missing_group_of_another_network_has_no_number_of_the_paper(make_run: MakeRun, runs: Path) -> None:
    make_run(model="rpn_r50_fpn", cells=["suction/normal/full", "suction/foreground/full"])
    report(runs)
    missing = next(
        r for r in _table(runs) if (r["primitive"], r["task"], r["model"]) == ("suction", "foreground", "rpn_r50_fpn")
    )
    assert (missing["note"], missing["paper_unseen"]) == ("no runs", "")


def test_figures_of_an_earlier_report_do_not_stay(make_run: MakeRun, runs: Path) -> None:
    make_run()
    report(runs)
    (runs / "figures" / "mine.png").touch()
    before = {path.stem for path in (runs / "figures").iterdir()}
    make_run(seed=1, config_hash="bbbbbbbbbbbb", evaluate__scenes="develop")
    report(runs)
    after = {path.stem for path in (runs / "figures").iterdir()}
    assert before & after == {"mine"}
    assert "curves-suction" in before
    assert {"curves-suction-1", "curves-suction-2"} <= after


@pytest.mark.parametrize("there", [True, False])
def test_a_folder_without_runs_is_refused_in_one_line(tmp_path: Path, there: bool) -> None:
    folder = tmp_path / "nothing"
    if there:
        folder.mkdir()
    done = subprocess.run(
        [sys.executable, str(Path(__file__).parents[2] / "report.py"), str(folder)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "multirun/sweep" in done.stderr
    with pytest.raises(UserError, match="holds no runs" if there else "is no folder"):
        report(folder)
    assert not there or not list(folder.iterdir())


@pytest.fixture
def sweep(make_run: MakeRun, runs: Path) -> Path:
    """Two groups with three seeds, a fixed one, an unfinished run, pictures and a film."""
    for seed in range(3):
        make_run("none-none", seed=seed, config_hash="aaaaaaaaaaaa", learned=[0] * 30 + [1] * 10)
        folder = make_run("normal-full", seed=seed, config_hash="bbbbbbbbbbbb", pictures=True)
        (folder / "video.mp4").touch()
        make_run("normal-fixed", seed=seed, config_hash="cccccccccccc", learned=[], primitive__attempts=40)
    make_run("none-none", seed=3, config_hash="aaaaaaaaaaaa", finished=False)
    report(runs)
    return runs


def test_the_page_is_whole_and_needs_nothing_else(sweep: Path) -> None:
    text = (sweep / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    kinds = {path.stem for path in (sweep / "figures").glob("*.png")}
    assert kinds == {f"{kind}-suction" for kind, *_ in plots.FIGURES}
    assert {path.stem for path in (sweep / "figures").glob("*.svg")} == kinds
    assert len(page.images) == len(kinds) + 2
    assert all(str(image["src"]).startswith("data:image/") and image["alt"] for image in page.images)
    links = [link for _, link in page.links if not link.startswith("data:")]
    video = next(link for link in links if link.endswith(".mp4"))
    assert (sweep / video).is_file()
    assert {link for link in links if link != video} <= {f"#{name}" for name in page.ids}
    assert not re.search(r"https?://", text)
    assert {path.name for path in sweep.iterdir()} == {
        *("suction", "report.html", "table.csv", "table.md", "progress.csv", "figures"),
    }


def test_the_page_shows_the_numbers_of_the_table(sweep: Path) -> None:
    rows, shown = _table(sweep), Page((sweep / "report.html").read_text()).cells
    assert set(shown) == set(range(len(rows)))
    for place, cells in shown.items():
        assert {column: rows[place][column] for column in cells} == cells
    measured = {column for column, text in rows[0].items() if text and column.startswith(("after", "zero", "argmax", "learn"))}
    assert measured <= set(shown[0])
    assert f"| 0.71 | {rows[0]['after_unseen_mean']} [" in (sweep / "table.md").read_text()


def test_the_markdown_has_a_table_of_success_on_the_way(sweep: Path) -> None:
    _, table, *_ = (sweep / "table.md").read_text().split("## Success on unseen objects on the way: suction")
    head, _, *lines = [line.removeprefix("| ").removesuffix(" |").split(" | ") for line in table.splitlines() if "|" in line]
    with (sweep / "progress.csv").open() as file:
        steps = [row for row in csv.DictReader(file) if row["primitive"] == "suction" and row["split"] == "unseen"]
    groups = {row["config_hash"]: row for row in _table(sweep) if row["config_hash"]}
    assert len(lines) == len(groups) > 1
    for line in lines:
        cells = dict(zip(head, line, strict=True))
        group = groups[cells["configuration"].split("`")[1]]
        mine = [row for row in steps if row["config_hash"] == group["config_hash"]]
        assert len(mine) > (group["transfer"] != "fixed")
        for row in mine:
            cell = cells["before" if row["step"] == "0" else f"after {row['step']}"]
            assert cell == f"{row['mean']} [{row['low']}, {row['high']}] ({row['successes']}/{row['attempts']})".replace(
                " [, ]", ""
            )
        assert cells["while learning"].split(" ")[0] == group["learning_mean"]
        reached = f" ({group['reach_seeds']} of {len(group['seeds'].split())})" if group["reach_median"] else ""
        assert cells["attempts until 0.8"].startswith(group["reach_median"])
        assert cells["attempts until 0.8"].endswith(reached)
    assert any(group["reach_median"] for group in groups.values())


def test_the_same_runs_give_the_same_files(sweep: Path) -> None:
    files = [sweep / "report.html", sweep / "table.csv", *sorted((sweep / "figures").iterdir())]
    before = [file.read_bytes() for file in files]
    report(sweep)
    assert [file.read_bytes() for file in files] == before


def test_what_is_kept_gives_the_same_tables_and_page(sweep: Path, make_run: MakeRun, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    main([str(sweep), "--keep", str(kept)])
    assert not (kept / "report.html").exists()
    assert not list(kept.rglob("checkpoints"))
    assert {path.suffix for path in kept.rglob("*.*") if path.is_file()} <= {".json", ".yaml", ".gz", ".jpg"}
    main([str(kept)])
    for name in ("table.csv", "table.md", "progress.csv"):
        assert (kept / name).read_bytes() == (sweep / name).read_bytes()
    assert (kept / "report.html").read_text().count("<img") == (sweep / "report.html").read_text().count("<img")
    drawn = {path.name for path in (sweep / "figures").iterdir()}
    assert {path.name for path in (kept / "figures").iterdir()} == drawn

    cut_short = kept / "suction/fcn7/normal-full/bbbbbbbbbbbb/seed1"
    (cut_short / "result.json").unlink()
    attempts = (cut_short / "attempts.csv.gz").read_bytes()
    (cut_short / "attempts.csv.gz").write_bytes(b"of a run before")
    assert [u.seed for u in report(kept).unfinished] == ["1"]
    later = make_run(seed=77)
    main([str(sweep), "--keep", str(kept)])  # what is there stays, what is new comes
    assert (kept / later.relative_to(sweep) / "result.json").is_file()
    assert (cut_short / "attempts.csv.gz").read_bytes() == attempts
    result = json.loads((later / "result.json").read_text())
    (later / "result.json").write_text(json.dumps(result | {"seconds": {"finetune": 1}}))  # the same outcomes, sooner
    main([str(sweep), "--keep", str(kept)])
    (later / "result.json").write_text(json.dumps(result | {"curve": []}))
    with pytest.raises(SystemExit, match="holds another run"):
        main([str(sweep), "--keep", str(kept)])
    for wrong, words in ((later / "result.json", "is a file"), (sweep / "kept", "would then find each run twice")):
        with pytest.raises(SystemExit, match=words):
            main([str(sweep), "--keep", str(wrong)])


def test_a_group_says_how_to_run_it_again(sweep: Path, make_run: MakeRun) -> None:
    words = "python train.py -m task=normal transfer=full primitive=suction threads=1 seed=0,1,2"
    assert words in (sweep / "report.html").read_text()
    make_run("edge-full", config_hash="dddddddddddd", evaluate__at="[0, 150]")
    group = next(group for comparison in report(sweep).comparisons for group in comparison.groups if group.task == "edge")
    assert command(group) == "python train.py task=edge transfer=full primitive=suction threads=1 'evaluate.at=[0, 150]' seed=0"
    make_run("corner-full", config_hash="eeeeeeeeeeee", experiment="smoke")
    group = next(group for comparison in report(sweep).comparisons for group in comparison.groups if group.task == "corner")
    assert command(group).startswith("python train.py -m task=corner")  # or it would not lie beside the others


@pytest.mark.usefixtures("no_figures")
def test_cells_of_an_experiment_that_are_missing_have_a_row(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0, cells=["suction/normal/full", "suction/normal/backbone", "grasp/edge/backbone"])
    make_run("none-none", seed=1)
    notices = report(runs).notices
    assert _row(runs, "normal", "backbone")["note"] == "no runs"
    assert not [
        row for row in _table(runs) if row["primitive"] == "grasp" and row["transfer"] == "backbone" and row["task"] == "edge"
    ]
    assert any("different seeds" in notice and "normal, full: 0" in notice for notice in notices)


@pytest.mark.usefixtures("no_figures")
def test_no_interval_is_made_from_two_seeds(make_run: MakeRun, runs: Path) -> None:
    for seed in range(2):
        make_run(seed=seed, unseen=[(seed, 10), (seed, 10)])
        make_run("none-none", seed=seed)
    report(runs)
    row = _row(runs, "normal", "full")
    assert (row["after_unseen_mean"], row["after_unseen_low"], row["gain_unseen_low"]) == ("0.050", "", "")
    page = (runs / "report.html").read_text()
    assert "too few seeds to conclude (2 and 2)" in page
    assert '<span class="interval">' not in page


def test_robot_time_and_causes_leave_out_a_run_whose_attempts_are_lost(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0)
    (make_run(seed=1) / "attempts.csv").unlink()
    (make_run(seed=2) / "attempts.csv").write_text("phase,split\nfinetune,seen\n")
    cut = make_run(seed=3)
    (cut / "attempts.csv.gz").write_bytes(gzip.compress((cut / "attempts.csv").read_bytes())[:-20])
    (cut / "attempts.csv").unlink()
    found = report(runs)
    assert _row(runs, "normal", "full")["seeds"] == "0 1 2 3"
    assert sum("attempts.csv" in notice for notice in found.notices) == 3
    assert any("there is no column 't_total'" in notice for notice in found.notices)


@pytest.mark.usefixtures("no_figures")
def test_a_run_without_its_configuration_is_kept_apart(make_run: MakeRun, runs: Path) -> None:
    make_run(seed=0)
    folder = make_run(seed=1)
    (folder / ".hydra" / "config.yaml").unlink()
    (folder / ".hydra" / "overrides.yaml").unlink()
    found = report(runs)
    assert [comparison.number for comparison in found.comparisons] == [1, 2]
    assert any("its protocol is unknown" in notice for notice in found.notices)
    assert any("configuration=unknown (1 group)" in notice for notice in found.notices)
    assert not any("absent" in notice for notice in found.notices)


def test_it_starts_without_torch() -> None:
    code = "import sys; import see2act.commands.report, see2act.analysis.page; print({'torch', 'pybullet'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60).stdout == "set()\n"
