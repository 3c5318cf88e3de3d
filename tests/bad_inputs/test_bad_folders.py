"""Folders of runs with damage in them: a report goes on without them and says so, a run refuses them."""

from __future__ import annotations

import csv
import gzip
import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from see2act.analysis import summary
from see2act.analysis.groups import Found, find
from see2act.commands import report
from see2act.experiment.attempts import COLUMNS, AttemptsCsv
from see2act.experiment.config import composed
from see2act.experiment.folder import claim, earlier_versions, of_this_version, refuse_foreign
from see2act.experiment.progress import Progress
from see2act.experiment.results import read_result
from see2act.experiment.stages.evaluate import _kept_evaluation
from see2act.files import write_json
from see2act.robot.layouts import Layouts
from tests.bad_inputs.refusals import (
    check_line,
    command_is_refused,
    damaged,
    examples,
    is_refused_or_done,
    refused,
    scratch,
)
from tests.factory import attempt_row, evaluation, finished_run

FILES = ("result.json", "attempts.csv", "run.json", ".hydra/config.yaml", ".hydra/overrides.yaml")


def _make_run(folder: Path, seed: int) -> None:
    """What a finished run leaves that a report reads."""
    result = finished_run(seed)
    folder.mkdir(parents=True)
    log = AttemptsCsv(folder / "attempts.csv")
    log.begin()
    log.append(*(attempt_row(step=step, success=bool(step % 2 == 0)) for step in range(1, 41)))
    write_json(folder / "result.json", result.model_dump(mode="json"))
    write_json(folder / "run.json", {"config_hash": result.config_hash, "seed": seed, "versions": result.versions})
    words = {"task": "normal", "transfer": "full", "primitive": "suction", "model": "fcn7", "objects": "diverse"}
    words |= {"workspace": "bin", "camera": "side", "policy": "suppress"}
    config = {key: {"name": word} for key, word in words.items()} | {"seed": seed, "finetune": {"attempts": "${attempts}"}}
    OmegaConf.save(OmegaConf.create(config | {"attempts": 40}), folder / "config.yaml")
    (folder / ".hydra").mkdir()
    (folder / "config.yaml").rename(folder / ".hydra" / "config.yaml")
    OmegaConf.save(OmegaConf.create(["task=normal", f"seed={seed}"]), folder / ".hydra" / "overrides.yaml")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs."""
    folder = tmp_path_factory.mktemp("good")
    for seed in (0, 1):
        _make_run(folder / f"seed{seed}", seed)
    found = find(folder)
    assert len(found.runs) == 2
    assert not found.broken
    assert not any("seed1" in notice for notice in found.notices)
    return folder


@pytest.fixture
def runs(good: Path) -> Iterator[Path]:
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        yield folder


def _told(folder: Path) -> Found:
    """What a report would say of a folder; everything that it reads, without the pictures."""
    found = find(folder)
    summary.rows(found)
    for comparison in found.comparisons:
        summary.progress(comparison)
    for _, reason in found.broken:
        check_line(reason)
    for notice in found.notices:
        check_line(notice)
    refused[0] += any("seed1" in notice for notice in found.notices)
    return found


@given(name=st.sampled_from(FILES), data=st.data())
@examples(20)
@example(name=".hydra/config.yaml", data=None)
@example(name=".hydra/overrides.yaml", data=None)
@example(name="attempts.csv", data=None)
def test_a_report_goes_on_whatever_is_damaged(name: str, data: st.DataObject | None, good: Path) -> None:
    content = (good / "seed1" / name).read_bytes()
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / name).write_bytes(data.draw(damaged(content)) if data else b"[" * 2000)
        found = _told(folder)
        assert any(run.folder.name == "seed0" for run in found.runs)


@given(name=st.sampled_from(FILES), share=st.floats(0, 0.99))
@examples(12)
def test_a_report_names_what_was_cut_short(name: str, share: float, good: Path) -> None:
    content = (good / "seed1" / name).read_bytes()
    cut = content[: int(share * len(content))]
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / name).write_bytes(cut)
        found = _told(folder)
        if name in ("result.json", "attempts.csv"):
            assert any("seed1" in notice for notice in found.notices)


SCALARS = st.one_of(st.none(), st.booleans(), st.integers(-5, 5), st.floats(), st.text(max_size=4))
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=2), st.dictionaries(st.text(max_size=4), inner, max_size=2)),
    max_leaves=4,
)


def _places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something is in nested lists and dictionaries."""
    if path:
        yield path
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        yield from _places(value, (*path, key))


def _put(node: Any, path: tuple[Any, ...], value: Any) -> None:
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value


@given(data=st.data(), value=VALUES)
@examples(25)
def test_a_result_of_other_types_is_left_out_or_harmless(data: st.DataObject, value: Any, good: Path) -> None:
    result = json.loads((good / "seed1" / "result.json").read_text())
    _put(result, data.draw(st.sampled_from([*_places(result)])), value)
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / "result.json").write_text(json.dumps(result))
        _told(folder)
        is_refused_or_done(lambda: read_result(folder / "seed1" / "result.json"))
        is_refused_or_done(lambda: of_this_version(folder / "seed1" / "result.json"))


@given(content=VALUES, name=st.sampled_from(["result.json", "run.json"]))
@examples(10)
def test_a_file_of_something_else_is_no_result(content: Any, name: str, good: Path) -> None:
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / name).write_text(json.dumps(content))
        found = _told(folder)
        assert bool(found.broken) is (name == "result.json")


@given(data=st.data(), value=VALUES, name=st.sampled_from([".hydra/config.yaml", ".hydra/overrides.yaml"]))
@examples(15)
@example(data=None, value={}, name=".hydra/config.yaml")
@example(data=None, value="word", name=".hydra/overrides.yaml")
@example(data=None, value={"a": 1}, name=".hydra/overrides.yaml")
@example(data=None, value=[None, 3, ["a"]], name=".hydra/overrides.yaml")
@example(data=None, value={None: 1}, name=".hydra/config.yaml")
@example(data=None, value={"a": "${b}"}, name=".hydra/config.yaml")
@example(data=None, value={"a": "${"}, name=".hydra/config.yaml")
@example(data=None, value={"primitive": None}, name=".hydra/config.yaml")
@example(data=None, value={"conditions": 5}, name=".hydra/config.yaml")
@example(data=None, value={"model": {"": "a\rb"}}, name=".hydra/config.yaml")
@example(data=None, value={"conditions": "["}, name=".hydra/config.yaml")
@example(data=None, value={"conditions": ["suction"]}, name=".hydra/config.yaml")
def test_configuration_of_other_types_does_not_end_a_report(
    data: st.DataObject | None, value: Any, name: str, good: Path
) -> None:
    content = yaml.safe_load((good / "seed1" / name).read_text())
    if data:
        _put(content, data.draw(st.sampled_from([*_places(content)])), value)
    else:
        content = value
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / name).write_text(yaml.safe_dump(content))
        _told(folder)


CELLS = st.one_of(st.text(max_size=5), st.sampled_from(["", "nan", "inf", "-1", "1e999", "9" * 5000, "\0", "é", '"', "\n"]))


@given(column=st.sampled_from(COLUMNS), row=st.integers(0, 39), cell=CELLS, packed=st.booleans())
@examples(15)
def test_attempts_with_other_cells_are_left_out_or_harmless(column: str, row: int, cell: str, packed: bool, good: Path) -> None:
    with (good / "seed1" / "attempts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rows[row][column] = cell
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    data = text.getvalue().encode()
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / "attempts.csv").unlink()
        path = folder / "seed1" / ("attempts.csv.gz" if packed else "attempts.csv")
        path.write_bytes(gzip.compress(data) if packed else data)
        _told(folder)
        is_refused_or_done(lambda: AttemptsCsv(path).begin())


@given(content=st.binary(max_size=60), packed=st.booleans(), finished=st.booleans())
@examples(10)
@example(content=b"\x1f\x8b\x08", packed=True, finished=False)
@example(content=b"a" * 200_000, packed=False, finished=True)
def test_attempts_of_whatever_bytes_do_not_end_a_report(content: bytes, packed: bool, finished: bool, good: Path) -> None:
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        (folder / "seed1" / "attempts.csv").unlink()
        (folder / "seed1" / ("attempts.csv.gz" if packed else "attempts.csv")).write_bytes(content)
        (folder / "seed1" / "failed.txt").write_bytes(content)
        if not finished:
            (folder / "seed1" / "result.json").unlink()
        found = _told(folder)
        assert len(found.unfinished) == (not finished)


@pytest.mark.parametrize("name", [*FILES, "failed.txt", "figures", "checkpoints"])
@pytest.mark.parametrize("kind", ["a folder", "a loop", "a link to nothing"])
def test_a_report_goes_on_where_a_file_should_be(name: str, kind: str, runs: Path) -> None:
    path = runs / "seed1" / name
    path.unlink(missing_ok=True)
    if kind == "a folder":
        path.mkdir()
    else:
        path.symlink_to(path.name if kind == "a loop" else "nothing")
    _told(runs)


# A run that is to go on in a folder


@pytest.fixture(scope="module")
def cfg() -> DictConfig:
    return composed(["precision=fp32"])


@pytest.fixture(scope="module")
def begun(cfg: DictConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was interrupted."""
    folder = tmp_path_factory.mktemp("begun")
    claim(folder, cfg)
    progress = Progress.load(folder / "progress.json")
    progress.seconds = {"collect": 3.0}
    progress.evaluations = {0: evaluation(((3, 10),), ((4, 10),))}
    progress.save()
    log = AttemptsCsv(folder / "attempts.csv")
    log.begin()
    log.append(attempt_row(step=1), attempt_row(step=2))
    return folder


def _resumed(folder: Path, cfg: DictConfig) -> None:
    """What a run reads of its folder before its first stage, and the log before the first attempt."""
    refuse_foreign(folder, cfg)
    earlier_versions(folder)
    Progress.load(folder / "progress.json")
    AttemptsCsv(folder / "attempts.csv").begin(lambda row: True)


@given(name=st.sampled_from(["run.json", "progress.json", "attempts.csv"]), data=st.data())
@examples(20)
def test_a_run_goes_on_or_says_what_is_damaged(name: str, data: st.DataObject, begun: Path, cfg: DictConfig) -> None:
    content = (begun / name).read_bytes()
    with scratch() as folder:
        shutil.copytree(begun, folder, dirs_exist_ok=True)
        (folder / name).write_bytes(data.draw(damaged(content)))
        is_refused_or_done(lambda: _resumed(folder, cfg))


@given(name=st.sampled_from(["run.json", "progress.json"]), data=st.data(), value=VALUES)
@examples(20)
@example(name="run.json", data=None, value=[])
@example(name="run.json", data=None, value={"versions": 3})
@example(name="run.json", data=None, value={"earlier_versions": {}})
@example(name="progress.json", data=None, value=3)
def test_a_run_goes_on_or_says_what_is_of_another_type(
    name: str, data: st.DataObject | None, value: Any, begun: Path, cfg: DictConfig
) -> None:
    content = json.loads((begun / name).read_text())
    if data:
        _put(content, data.draw(st.sampled_from([*_places(content)])), value)
    else:
        content = value
    with scratch() as folder:
        shutil.copytree(begun, folder, dirs_exist_ok=True)
        (folder / name).write_text(json.dumps(content))
        is_refused_or_done(lambda: _resumed(folder, cfg))


# Files of the cache


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    row = attempt_row(step=0).texts()
    block = {"name": "cube", "scale": 1.0, "color": [1, 0, 0], "position": [0, 0, 0.02], "rotation": [0, 0, 0, 1]}
    return {
        "evaluation.json": {"result": evaluation(((3, 10),), ((4, 10),)).model_dump(mode="json"), "rows": [row]},
        "seen-all-3.json": {"objects": [block], "refused": []},
    }


CACHED: dict[str, Callable[[Path], object]] = {
    "evaluation.json": _kept_evaluation,
    "seen-all-3.json": lambda path: Layouts(path.parent).get(3, "seen", None),
}


@given(name=st.sampled_from(sorted(CACHED)), data=st.data(), value=VALUES)
@examples(25)
def test_a_file_of_the_cache_is_read_or_called_damaged(
    name: str, data: st.DataObject, value: Any, kept: dict[str, Any]
) -> None:
    content = json.loads(json.dumps(kept[name]))
    _put(content, data.draw(st.sampled_from([*_places(content)])), value)
    with scratch() as folder:
        (folder / name).write_text(json.dumps(content))
        is_refused_or_done(lambda: CACHED[name](folder / name), folder)


# The command


@pytest.mark.parametrize(
    "arguments",
    [[], ["{}/nothing"], ["{}/seed0/run.json"], ["{}/empty"], ["{}", "--keep"], ["{}", "--keep", "{}/inside"]]
    + [["{}", "--keep", "{}/seed0/run.json"], ["{}", "more"], ["--nonsense", "{}"], ["/dev/null"], ["{}/" + "x" * 300]],
    ids=str,
)
def test_a_report_of_nothing_is_refused(arguments: list[str], runs: Path) -> None:
    (runs / "empty").mkdir()
    command_is_refused(report.main, [argument.replace("{}", str(runs)) for argument in arguments], runs)


@pytest.mark.parametrize("name", ["report.html", "table.csv", "table.md", "progress.csv", "figures"])
def test_a_report_that_cannot_be_written_says_so(name: str, runs: Path) -> None:
    if name == "figures":
        (runs / name).touch()
    else:
        (runs / name).mkdir()
    command_is_refused(report.main, [str(runs)])


@given(data=st.data())
@examples(1)
def test_a_whole_report_is_written_beside_damage(data: st.DataObject, good: Path) -> None:
    with scratch() as folder:
        shutil.copytree(good, folder, dirs_exist_ok=True)
        for name in FILES:
            content = (folder / "seed1" / name).read_bytes()
            (folder / "seed1" / name).write_bytes(data.draw(damaged(content)))
        report.main([str(folder)])
        assert (folder / "report.html").is_file()
        refused[0] += any("seed1" in notice for notice in find(folder).notices)
