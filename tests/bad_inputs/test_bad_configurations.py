"""Configurations that cannot run: wrong values for every key, and command lines that are none."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from see2act.experiment.annotations import check_arguments, check_schema
from see2act.experiment.checks import GIVEN
from see2act.experiment.config import composed
from see2act.experiment.preflight import check_command, check_sweep
from tests.bad_inputs.refusals import examples, is_refused, is_refused_or_done, scratch
from tests.bad_inputs.values import MAPPINGS, NOT_FINITE, WORDS, Kind, keys_of_classes, keys_of_schema

CHOICES = ((), ("primitive=grasp", "task=normal", "model=rpn_r50_fpn", "camera=realsense", "objects=random_urdfs"))
SCHEMA = dict(keys_of_schema())
CLASSES = [(choice, dict(keys_of_classes(composed(choice)))) for choice in CHOICES]
GROUPS = ("task", "transfer", "primitive", "model", "objects", "workspace", "camera", "robot", "policy", "trainer", "logger")
BUILT = ("objects", "workspace", "camera", "camera.noise", "robot", "robot.arm", "robot.bin", "policy", "task.label")


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    return {choice: OmegaConf.to_container(composed(choice), resolve=True) for choice in CHOICES}


def _changed(config: Any, key: str, value: Any) -> Any:
    changed = copy.deepcopy(config)
    *path, last = key.split(".")
    node = changed
    for part in path:
        node = node[part]
    node[last] = value
    return OmegaConf.create(changed)


def _by_group(keys: Iterable[str]) -> dict[str, list[str]]:
    return {group: list(members) for group, members in groupby(sorted(keys), lambda key: key.split(".")[0])}


@pytest.mark.parametrize("group", _by_group(SCHEMA))
@given(data=st.data())
@examples(1)
def test_every_key_of_the_schema_refuses_what_it_cannot_hold(group: str, data: st.DataObject, plain: dict) -> None:
    for key in _by_group(SCHEMA)[group]:
        value = data.draw(SCHEMA[key].wrong(), label=key)
        assert key in is_refused(partial(check_schema, _changed(plain[()], key, value)))


@pytest.mark.parametrize(("choice", "group"), [(choice, group) for choice, keys in CLASSES for group in _by_group(keys)])
@given(data=st.data())
@examples(1)
def test_every_argument_of_what_is_built_refuses_what_it_cannot_hold(
    choice: tuple[str, ...], group: str, data: st.DataObject, plain: dict
) -> None:
    kinds, given, partial_ = dict(CLASSES)[choice], GIVEN.get(group, ()), group in ("trainer", "logger")
    for key in _by_group(kinds)[group]:
        value = data.draw(kinds[key].wrong(), label=key)
        cfg = _changed({group: plain[choice][group]}, key, value)[group]
        assert key in is_refused(partial(check_arguments, cfg, group, given, partial_))


# Whole command lines


def _places(folder: Path) -> list[str]:
    return [f"paths.cache={folder}/cache", f"hydra.run.dir={folder}/run", "precision=fp32"]


def _refused(*overrides: str) -> str:
    with scratch() as folder:
        return is_refused(lambda: check_command([*_places(folder), *overrides]), folder)


def _typed(value: Any) -> str:
    match value:
        case None:
            return "null"
        case str():
            return f'"{value}"'
        case list():
            return f"[{','.join(map(_typed, value))}]"
        case dict():
            return f"{{{','.join(f'{key}:{_typed(item)}' for key, item in value.items())}}}"
        case _:
            return str(value)


def _of(keys: dict[str, Kind]) -> st.SearchStrategy[str]:
    return st.sampled_from(sorted(keys)).flatmap(lambda key: keys[key].wrong().map(lambda value: f"{key}={_typed(value)}"))


@given(override=st.one_of(_of(SCHEMA), _of(CLASSES[0][1])))
@examples(8)
@example(override="finetune.temperature=nan")
@example(override="camera.noise.step=0")
@example(override="workspace.width=[]")
@example(override="robot.bin.settle_steps=-1")
@example(override="primitive.angles=99999999999")
@example(override="collect.interactions=99999999999")
@example(override="objects.copies=99999999999")
@example(override="threads=100000")
@example(override="model.width=300000")
def test_a_wrong_value_is_refused_before_a_folder_is_made(override: str) -> None:
    assert override.split("=")[0].split(".")[-1] in _refused(override)


@given(part=st.sampled_from(BUILT), value=st.one_of(NOT_FINITE, st.integers(-3, 3), WORDS, st.booleans(), st.none()))
@examples(3)
@example(part="camera.noise", value=5)
@example(part="camera.randomization", value=None)
@example(part="robot.arm", value=0.5)
@example(part="model.network", value=True)
@example(part="trainer", value="[]")
@example(part="robot", value=[])
def test_what_is_built_from_a_mapping_takes_nothing_else(part: str, value: Any) -> None:
    _refused(f"{part}={_typed(value)}")


@given(
    part=st.sampled_from((*BUILT, "model.network", "primitive.end_effector")),
    name=st.one_of(
        WORDS, st.integers(-3, 3), NOT_FINITE, st.none(), st.sampled_from(["", "a b", "see2act.robot", "x/../y", ".."])
    ),
)
@examples(3)
@example(part="robot", name="see2act.robot.simulated.SimulatedRobots")
@example(part="policy", name="os")
def test_a_target_that_is_no_class_is_refused(part: str, name: Any) -> None:
    assert "_target_" in _refused(f"{part}._target_={_typed(name)}")


@given(group=st.sampled_from(GROUPS), option=st.one_of(WORDS, st.lists(st.integers(-3, 3), min_size=1, max_size=2), MAPPINGS))
@examples(4)
@example(group="model", option=[[1]])
@example(group="robot", option=float("nan"))
def test_an_option_that_does_not_exist_is_refused(group: str, option: Any) -> None:
    _refused(f"{group}={_typed(option)}")


@given(key=st.sampled_from(sorted({*SCHEMA, *CLASSES[0][1]})), other=WORDS, sign=st.sampled_from(["", "+", "++", "~"]))
@examples(4)
def test_a_key_that_does_not_exist_is_refused(key: str, other: str, sign: str) -> None:
    _refused(f"{sign}{key}{other}=1")


@given(key=st.sampled_from([key for key in CLASSES[0][1] if key.startswith(("robot", "task", "primitive", "camera.noise"))]))
@examples(1)
@example(key="robot.arm")
@example(key="seed")
@example(key="finetune")
@example(key="paths.cache")
@example(key="task.name")
def test_a_configuration_from_which_a_key_was_taken_runs_or_is_refused(key: str) -> None:
    with scratch() as folder:
        is_refused_or_done(lambda: check_command([*_places(folder), f"~{key}"]), folder)


NOISE = st.text("[]{}()=,:$'\"\\ ~+@|*.\n\té😀abc019-", max_size=12)


@given(
    words=st.lists(st.one_of(NOISE, st.text(max_size=8), NOISE.map(lambda noise: f"seed={noise}")), min_size=1, max_size=3),
    sweep=st.booleans(),
)
@examples(15)
@example(words=["seed=" + "[" * 500], sweep=False)
@example(words=["seed=" + "[" * 3000 + "]" * 3000], sweep=False)
@example(words=["seed=${seed}"], sweep=False)
@example(words=["robot.motion='a\nb'"], sweep=False)
@example(words=["objects.name='a\nb'"], sweep=False)
@example(words=["=", "=="], sweep=True)
@example(words=["task=edge,"], sweep=True)
@example(words=["'seed=1'"], sweep=True)
def test_whatever_is_typed_is_composed_or_refused_in_a_line(words: Sequence[str], sweep: bool) -> None:
    with scratch() as folder:
        check = check_sweep if sweep else check_command
        is_refused_or_done(lambda: check([*_places(folder), *words]), folder)


CONTRADICTIONS = (
    ("task=none",),
    ("transfer=none",),
    ("task=imagenet", "transfer=full", "model=rpn_r50_fpn"),
    ("task=coco",),
    ("task=affordance",),
    ("labels=vision", "robot.bin.floor=textured"),
    ("robot.bin.distractors=3",),
    ("finetune.robots=7",),
    ("collect.interactions=8",),
    ("collect.folder=somewhere",),
    ("objects.kinds=16",),
    ("objects.seen=[cube]",),
    ("objects.unseen=[cube,brick,can,puck,ell]",),
    ("objects.scale=[1,0.5]",),
    ("objects.scale=[nan,1]",),
    ("camera.position=0.5",),
    ("camera.up=[1,2]",),
    ("camera.up=[0,0,0]",),
    ("robot.arm.home=[0,0]",),
    ("robot.arm.base=5",),
    ("workspace.pixel=1e-9",),
    ("workspace.width=1e30",),
    ("primitive.footprint=[nan,nan]",),
    ("primitive.footprint=[]",),
    ("primitive.footprint=[0.01,0.01,0.01]",),
    ("task.label=null",),
    ("task.weights=/",),
    ("trainer.accelerator=tpu",),
    ("trainer.devices=[]",),
    ("trainer.strategy=nonsense",),
    ("+trainer.callbacks=[1]",),
    ("trainer._partial_=false",),
    ("objects._partial_=true",),
    ("+camera.noise._args_=[1]",),
    ("logger=none", "+logger.project=mine"),
    ("task.label.blur=0",),
    ("task.label.blur=1e9",),
    ("task=corner", "task.label.window=1e9"),
    ("task=corner", "task.label.radius=1e9"),
    ("task=normal", "task.label.window=1e9"),
    ("task.label.pixel=0",),
    ("robot=ur5_real",),
    ("robot.layouts=7",),
    ("experiment=smoke",),
    ("+experiment=[smoke]",),
)


@pytest.mark.parametrize("overrides", CONTRADICTIONS, ids=" ".join)
@given(more=st.sampled_from([(), ("seed=3",), ("primitive=grasp",), ("force=true",)]))
@examples(1)
def test_what_contradicts_itself_is_refused(overrides: tuple[str, ...], more: tuple[str, ...]) -> None:
    _refused(*overrides, *more)


PLACES = st.sampled_from(["a file", "a file/below", "/dev/null", "/dev/null/a/b"])


@given(key=st.sampled_from(["paths.cache", "hydra.run.dir"]), place=PLACES)
@examples(3)
def test_a_folder_that_cannot_be_is_refused(key: str, place: str) -> None:
    with scratch() as folder:
        (folder / "a file").touch()
        is_refused(lambda: check_command([*_places(folder), f'{key}="{folder / place}"']), folder)
