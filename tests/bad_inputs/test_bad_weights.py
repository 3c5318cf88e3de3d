"""Weights that are damaged, of something else, or no numbers: refused before anything is begun."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import DictConfig
from safetensors.torch import save as serialized

from see2act.commands import demo
from see2act.errors import storage_errors
from see2act.experiment import build, model_file
from see2act.experiment.checkpoints import load_checkpoint
from see2act.experiment.config import composed
from see2act.experiment.preflight import check_command
from see2act.experiment.stages.finetune import _attempts_in
from see2act.experiment.stages.transfer import check_weights
from see2act.modules import weights
from tests.bad_inputs.refusals import command_is_refused, damaged, examples, is_refused, is_refused_or_done, scratch

SMALL = ("model.width=2", "precision=fp32")


@pytest.fixture(scope="module")
def cfg() -> DictConfig:
    return composed(SMALL)


@pytest.fixture(scope="module")
def state(cfg: DictConfig) -> dict[str, torch.Tensor]:
    return {
        key: value.clone(memory_format=torch.contiguous_format) for key, value in build.network(cfg, 0).state_dict().items()
    }


def _saved(content: object) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


@pytest.fixture(scope="module")
def files(cfg: DictConfig, state: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Good files, by what they are."""
    model = tmp_path_factory.mktemp("model") / "model.safetensors"
    model_file.save(model, build.network(cfg, 0), composed([*SMALL, "task=none", "transfer=none"]))
    last = {"InteractiveDataModule": {"attempts": 3}, "state_dict": state}
    return {
        "vision.ckpt": _saved({"task": "edge", "network": state}),
        "state.safetensors": serialized(state),
        "model.safetensors": model.read_bytes(),
        "last.ckpt": _saved(last),
    }


def _readers(cfg: DictConfig) -> dict[str, Callable[[Path], object]]:
    """What reads each of these files in a run."""

    def given(path: Path) -> None:
        ours = cfg.copy()
        ours.task.weights = str(path)
        check_weights(ours)

    return {
        "vision.ckpt": given,
        "state.safetensors": given,
        "model.safetensors": model_file.load,
        "last.ckpt": _attempts_in,
    }


NAMES = st.sampled_from(["vision.ckpt", "state.safetensors", "model.safetensors", "last.ckpt"])


def test_the_good_files_are_read(cfg: DictConfig, files: dict[str, bytes], tmp_path: Path) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        _readers(cfg)[name](tmp_path / name)


@given(name=NAMES, share=st.floats(0, 1, exclude_max=True))
@examples(15)
def test_a_file_that_was_cut_short_is_refused(name: str, share: float, cfg: DictConfig, files: dict[str, bytes]) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(files[name][: int(share * len(files[name]))])
        is_refused(lambda: _readers(cfg)[name](folder / name), folder)


@given(name=NAMES, content=st.binary(max_size=300))
@examples(15)
@example(name="last.ckpt", content=b"PK\x03\x04")
@example(name="vision.ckpt", content=b"\x80\x02.")
@example(name="model.safetensors", content=b"\xff" * 8)
@example(name="model.safetensors", content=(2).to_bytes(8, "little") + b"{}")
@example(name="state.safetensors", content=(2).to_bytes(8, "little") + b"[]")
def test_whatever_bytes_are_no_weights(name: str, content: bytes, cfg: DictConfig) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(content)
        is_refused(lambda: _readers(cfg)[name](folder / name), folder)


@given(name=NAMES, data=st.data())
@examples(40)
def test_damage_is_refused_or_does_no_harm(name: str, data: st.DataObject, cfg: DictConfig, files: dict[str, bytes]) -> None:
    with scratch() as folder:
        (folder / name).write_bytes(data.draw(damaged(files[name])))
        is_refused_or_done(lambda: _readers(cfg)[name](folder / name), folder)


# Well-formed files with something else in them

FLAWS: dict[str, Callable[[torch.Tensor], Any]] = {
    "another shape": lambda value: value[None],
    "a row less": lambda value: value[:-1] if value.ndim else value[None],
    "no values": lambda value: value.new_zeros(0),
    "not a number": lambda value: torch.full_like(value, float("nan"), dtype=torch.float32),
    "infinite": lambda value: torch.full_like(value, float("inf"), dtype=torch.float32),
    "too large": lambda value: torch.full_like(value, 1e300, dtype=torch.float64),
    "whole numbers": lambda value: value.to(torch.int32),
    "complex": lambda value: value.to(torch.complex64),
}
OTHERS: dict[str, Any] = {"a word": "word", "a number": 3.0, "nothing": None, "a list": [torch.zeros(1)]}


@given(data=st.data(), flaw=st.sampled_from(sorted({**FLAWS, **OTHERS})), packed=st.booleans())
@examples(15)
def test_other_values_are_refused(
    data: st.DataObject, flaw: str, packed: bool, cfg: DictConfig, state: dict[str, torch.Tensor]
) -> None:
    key = data.draw(st.sampled_from([key for key, value in state.items() if value.is_floating_point()]))
    with scratch() as folder:
        changed = {**state, key: FLAWS[flaw](state[key]) if flaw in FLAWS else OTHERS[flaw]}
        packed &= flaw in FLAWS
        path = folder / ("state.safetensors" if packed else "state.ckpt")
        path.write_bytes(serialized(changed) if packed else _saved({"task": "edge", "network": changed}))
        is_refused(lambda: _readers(cfg)["vision.ckpt"](path), folder)


@given(data=st.data(), change=st.sampled_from(["lost", "renamed", "more"]))
@examples(8)
def test_other_keys_are_refused(data: st.DataObject, change: str, cfg: DictConfig, state: dict[str, torch.Tensor]) -> None:
    key = data.draw(st.sampled_from([key for key in state if not key.startswith("normalization.average")]))
    changed = {**state}
    if change != "more":
        value = changed.pop(key)
    if change != "lost":
        part = key.split(".")[0]
        changed[f"{part}.{data.draw(st.text('abc.', min_size=1, max_size=9))}"] = state[key] if change == "more" else value
    with scratch() as folder:
        (folder / "vision.ckpt").write_bytes(_saved({"task": "edge", "network": changed}))
        is_refused(lambda: _readers(cfg)["vision.ckpt"](folder / "vision.ckpt"), folder)


@given(
    content=st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just(torch.zeros(2))),
        lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=9), inner, max_size=3)),
        max_leaves=6,
    ),
    under=st.sampled_from([None, "network", "state_dict", "model", "InteractiveDataModule"]),
)
@examples(15)
@example(content={}, under="network")
@example(content={"weight": [1]}, under="state_dict")
@example(content=3, under="network")
def test_other_contents_of_torch_are_refused(content: Any, under: str | None, cfg: DictConfig) -> None:
    with scratch() as folder:
        path = folder / "vision.ckpt"
        path.write_bytes(_saved({under: content} if under else content))
        is_refused(lambda: _readers(cfg)["vision.ckpt"](path), folder)
        is_refused(lambda: load_checkpoint(path, ("task", "network")), folder)


# Lies in a safetensors file

LIES: dict[str, Callable[[dict[str, Any], str], object]] = {
    "an end beyond the file": lambda head, key: head[key].update(data_offsets=[0, 10**12]),
    "ends in the wrong order": lambda head, key: head[key].update(data_offsets=[8, 0]),
    "a huge shape": lambda head, key: head[key].update(shape=[10**9, 10**9]),
    "a negative shape": lambda head, key: head[key].update(shape=[-1]),
    "a shape of words": lambda head, key: head[key].update(shape=["a"]),
    "an unknown type": lambda head, key: head[key].update(dtype="F31"),
    "another type": lambda head, key: head[key].update(dtype="F64"),
    "no type": lambda head, key: head[key].pop("dtype"),
    "an overlap": lambda head, key: head[key].update(data_offsets=head["normalization.std"]["data_offsets"]),
    "no offsets": lambda head, key: head[key].pop("data_offsets"),
    "a tensor less": lambda head, key: head.pop(key),
    "metadata of numbers": lambda head, key: head.update(__metadata__={"a": 1}),
    "a tensor that is a word": lambda head, key: head.update({key: "word"}),
}


@given(lie=st.sampled_from(sorted(LIES)), name=st.sampled_from(["state.safetensors", "model.safetensors"]), data=st.data())
@examples(15)
def test_lies_of_a_header_are_refused(
    lie: str, name: str, data: st.DataObject, cfg: DictConfig, files: dict[str, bytes]
) -> None:
    content = files[name]
    size = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + size])
    key = data.draw(st.sampled_from([key for key, value in head.items() if key.startswith("backbone") and value["shape"]]))
    LIES[lie](head, key)
    told = json.dumps(head).encode()
    with scratch() as folder:
        (folder / name).write_bytes(len(told).to_bytes(8, "little") + told + content[8 + size :])
        is_refused(lambda: _readers(cfg)[name](folder / name), folder)


@given(
    key=st.sampled_from(["model.network._target_", "model.network", "model", "primitive", "workspace", "primitive.name"]),
    value=st.one_of(st.none(), st.integers(), st.text(max_size=5), st.lists(st.integers(), max_size=2)),
)
@examples(15)
@example(key="primitive.name", value="suction")
def test_a_model_says_what_it_is_or_is_refused(key: str, value: Any, files: dict[str, bytes]) -> None:
    content = files["model.safetensors"]
    size = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + size])
    config = json.loads(head["__metadata__"][model_file.CONFIG])
    *path, last = key.split(".")
    node = config
    for part in path:
        node = node[part]
    node[last] = value
    head["__metadata__"][model_file.CONFIG] = json.dumps(config)
    told = json.dumps(head).encode()
    with scratch() as folder:
        bad = folder / "model.safetensors"
        bad.write_bytes(len(told).to_bytes(8, "little") + told + content[8 + size :])
        is_refused_or_done(lambda: _used(model_file.load(bad)), folder)


def _used(model: model_file.TrainedModel) -> None:
    """What every command asks of a model."""
    assert model.primitive not in ("", "None")
    assert model.pixel > 0


@given(value=st.sampled_from([float("nan"), float("inf"), -float("inf")]), data=st.data())
@examples(4)
def test_a_model_that_diverged_picks_nothing(
    value: float, data: st.DataObject, cfg: DictConfig, state: dict[str, torch.Tensor], files: dict[str, bytes]
) -> None:
    content = files["model.safetensors"]
    head = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    key = data.draw(st.sampled_from([key for key, tensor in state.items() if tensor.is_floating_point()]))
    changed = {name: tensor.clone() for name, tensor in state.items()}
    changed[key].view(-1)[0] = value
    with scratch() as folder:
        bad = folder / "model.safetensors"
        bad.write_bytes(serialized(changed, head["__metadata__"]))
        assert "finite" in is_refused(lambda: model_file.load(bad), folder)


# Paths


@pytest.mark.parametrize("name", ["nothing", "a folder", "a loop", "a file/below", "x" * 300, "line\nbreak", "/dev/null"])
def test_a_path_that_leads_nowhere_is_refused(name: str, cfg: DictConfig, tmp_path: Path) -> None:
    (tmp_path / "a folder").mkdir()
    (tmp_path / "a file").touch()
    (tmp_path / "a loop").symlink_to("a loop")
    given, ours, places = str(tmp_path / name), cfg.copy(), [f"paths.cache={tmp_path}/cache", f"hydra.run.dir={tmp_path}/run"]
    ours.task.weights = given

    def typed() -> None:
        with storage_errors():  # as in every command
            check_command([*places, *SMALL, f'task.weights="{given}"'])

    is_refused(typed, tmp_path)
    is_refused(lambda: check_weights(ours), tmp_path)
    is_refused(lambda: weights.task_of(Path(given)), tmp_path)
    options = ["--checkpoint", given, "--out", str(tmp_path / "out"), "--no-film", places[0]]
    command_is_refused(demo.main, options, tmp_path)
