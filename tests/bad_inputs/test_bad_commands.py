"""What is typed after the commands: options that do not exist, numbers out of range, files that are none."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from see2act.commands import coco, demo, heatmaps, main, real, train
from see2act.robot.real import station as stations
from see2act.robot.real.setup import new
from see2act.robot.real.setup.calibrate import Recording
from tests.bad_inputs.refusals import command_is_refused, damaged, examples, is_refused, is_refused_or_done, scratch


def _typed(command: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], object]:
    """A command that looks at the process's arguments."""

    def call(arguments: list[str]) -> object:
        monkeypatch.setattr(sys, "argv", ["command", *arguments])
        return command()

    return call


TRAIN = """
--nonsense
-x
-m --nonsense
--cfg
--cfg nonsense
--info nonsense
--resolve
--config-name nonsense
--config-dir /nonsense
--cfg job task=nonsense
--cfg job =
--cfg job --resolve precision=fp32 'finetune.attempts=${nonsense}'
--help task=nonsense
task
seed=1 2
hydra/launcher=nonsense
hydra.nonsense=1
hydra.run=5
hydra.run.dir=
hydra.run.dir="' '"
paths.cache=
-m hydra/launcher=nonsense
-m hydra.launcher.n_jobs=x
-m hydra.launcher.n_jobs=0
-m hydra.launcher.n_jobs=1.5
-m hydra.launcher.nonsense=1
-m hydra.sweep.dir=/dev/null/x
-m hydra.sweep.dir=
-m hydra.sweep.subdir=/elsewhere
-m hydra.sweep.subdir=../elsewhere
-m experiment=nonsense
-m seed=
-m 'seed=range(3,3)'
-m task=edge,nonsense
-m paths.cache=
"""


@pytest.mark.parametrize("line", TRAIN.strip().splitlines())
def test_train_refuses_what_it_does_not_know(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    command_is_refused(_typed(train.main, monkeypatch), shlex.split(line), tmp_path)
    assert "Traceback" not in capsys.readouterr().err


@given(words=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9), min_size=1, max_size=3))
@examples(8)
@example(words=["--"])
@example(words=["predictt"])
@example(words=["../train"])
def test_there_is_no_other_command(words: list[str]) -> None:
    if words[0] in (*main.COMMANDS, "-h", "--help"):
        return
    with pytest.MonkeyPatch.context() as monkeypatch, scratch() as folder:
        monkeypatch.chdir(folder)
        command_is_refused(_typed(main.main, monkeypatch), words, folder)


DEMO = """
--nonsense
--seed 3
seed
seed=x
primitive=push
objects=nonsense
task=edge
--out /dev/null
--out /dev/null/x
camera.focal=nan
robot=ur5_real
objects.scale=[2,3]
--dry-run
primitive=grasp_rg2
robot.video=5
threads=0
model=nonsense
--checkpoint
--checkpoint ''
--no-film=3
evaluate.attempts.unseen=0
+nonsense=1
policy.radius=-1
"""


@pytest.mark.parametrize("line", DEMO.strip().splitlines())
def test_a_demo_of_nothing_is_refused(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = [] if "--out" in line else ["--out", "out"]
    command_is_refused(demo.main, ["paths.cache=cache", *out, "--no-film", *shlex.split(line)], tmp_path)


HEATMAPS = """
--scenes 0
--scenes -1
--scenes x
--scenes 1.5
--scenes 99999999999
--tasks ''
--tasks edge,
--tasks nonsense
--tasks edge,edge,x
--tasks ../edge
--run ''
--run .
--run nowhere
--run /dev/null
--out /dev/null
transfer=full
task=edge
--nonsense
seed=x
camera.noise=3
primitive=push
robot=ur5_real
--tasks affordance
"""


@pytest.mark.parametrize("line", HEATMAPS.strip().splitlines())
def test_heatmaps_of_nothing_are_refused(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = [] if "--out" in line else ["--out", "out"]
    command_is_refused(heatmaps.main, ["paths.cache=cache", *out, *shlex.split(line)], tmp_path)


OVERRIDES = [
    b"",
    b"{",
    b"3",
    b"word",
    b"{a: 1}",
    b"[3]",
    b"[[a]]",
    b"- nonsense=1",
    b"- task",
    b"[" * 2000,
    b"\xff",
    b"- 'seed=x'",
]


@pytest.mark.parametrize("content", OVERRIDES)
@pytest.mark.parametrize("name", ["overrides.yaml", "hydra.yaml"])
def test_heatmaps_of_a_damaged_run_are_refused(
    content: bytes, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    for file, good in (("checkpoints/affordance.ckpt", b"none"), (".hydra/overrides.yaml", b"[]"), (f".hydra/{name}", content)):
        (run / file).parent.mkdir(parents=True, exist_ok=True)
        (run / file).write_bytes(good)
    command_is_refused(heatmaps.main, ["--run", "run", "--out", "out", "paths.cache=cache", "--tasks", "none"], tmp_path)
    (run / "checkpoints" / "affordance.ckpt").unlink()
    if name == "overrides.yaml":
        is_refused_or_done(lambda: heatmaps._of_run(run, []), tmp_path)


REAL = """
nonsense
new
new --host 10.0.0.9 --tool vacuum_io
new --host 10.0.0.9 --tool vacuum_io --tip x
new --host 10.0.0.9 --tool vacuum_io --tip nan
new --host 10.0.0.9 --tool vacuum_io --tip inf
new --host 10.0.0.9 --tool vacuum_io --tip 0
new --host 10.0.0.9 --tool vacuum_io --tip -0.1
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --mass nan
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --mass -1
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --station /dev/null
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --station /dev/null/x
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --station ''
new --host 10.0.0.9 --tool vacuum_io --tip 0.1 --tool-host 10.0.0.8
new --host h --tool hook --tip 0.1
new --host h --tool vg10 --tip 0.1
check
check --station /dev/null
check seed=x
check camera=side
check --nonsense
board --columns 0
board --rows -3
board --columns 99999
board --square nan
board --square 0
board --square inf
board --columns x
board --out /dev/null/x
teach
teach --places ''
teach --places nowhere
teach --places home,
calibrate
calibrate --views nothing.npz
calibrate --centre 1 2
calibrate --centre a b c
touch
touch --square -1
background
background robot.contact_limit=inf
background robot=ur5
"""


@pytest.mark.parametrize("line", REAL.strip().splitlines())
def test_a_station_of_nothing_is_refused(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    command_is_refused(real.main, shlex.split(line), tmp_path)


@pytest.mark.parametrize("arguments", [["--nonsense"], ["more"], ["--cache"]], ids=" ".join)
def test_coco_takes_no_other_options(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    command_is_refused(_typed(coco.main, monkeypatch), arguments, tmp_path)


# Files of a station


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("station") / "station.yaml"
    new.new(path, "10.0.0.9", "vacuum_io", 0.14)
    return path.read_bytes()


def _loaded(content: bytes, folder: Path) -> Callable[[], object]:
    (folder / "station.yaml").write_bytes(content)
    return lambda: stations.load(folder / "station.yaml")


@given(data=st.data())
@examples(15)
def test_damage_of_a_station_is_refused_or_does_no_harm(data: st.DataObject, station: bytes) -> None:
    with scratch() as folder:
        is_refused_or_done(_loaded(data.draw(damaged(station)), folder), folder)


VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-5, 5), st.floats(), st.text("ab:[]{}&*!-\n", max_size=4)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text("ab", max_size=3), inner, max_size=2)),
    max_leaves=5,
)


@given(
    section=st.sampled_from(["robot", "tool", "bin", "background", "calibration", "touch", "a"]), data=st.data(), value=VALUES
)
@examples(20)
@example(section="bin", data=None, value=[[0, 0, 0]] * 3)
@example(section="bin", data=None, value=[[float("nan")] * 3] * 3)
@example(section="tool", data=None, value={"kind": "hook"})
@example(section="calibration", data=None, value={"camera": [[]]})
def test_a_station_of_other_values_is_refused_or_harmless(
    section: str, data: st.DataObject | None, value: Any, station: bytes
) -> None:
    content = yaml.safe_load(station)
    inner = content.get(section)
    if data and isinstance(inner, dict):
        inner[data.draw(st.sampled_from([*inner, "more"]))] = value
    else:
        content[section] = value
    with scratch() as folder:
        is_refused_or_done(_loaded(yaml.safe_dump(content).encode(), folder), folder)


@given(content=st.binary(max_size=80))
@examples(5)
@example(content=b"")
@example(content=b"[" * 2000)
@example(content=b"a: &a [*a]")
@example(content=b"robot: !!python/object/apply:os.getcwd []")
@example(content=b"\xff\xfe\x00")
def test_whatever_bytes_are_no_station(content: bytes) -> None:
    with scratch() as folder:
        is_refused(_loaded(content, folder), folder)
        (folder / "views.npz").write_bytes(content)
        is_refused(lambda: Recording.load(folder / "views.npz"), folder)
