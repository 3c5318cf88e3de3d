"""Files that run code when a careless reader opens them: they are refused wherever files are read, and nothing is run."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import save as serialized

from see2act.commands import demo, heatmaps, predict, report
from see2act.datamodules.collect import ARRAYS, BACKGROUND, Collection
from see2act.datamodules.observations import Observations
from see2act.datamodules.records import Records
from see2act.experiment import build, model_file
from see2act.experiment.checkpoints import load_checkpoint
from see2act.experiment.config import composed
from see2act.experiment.precision import _read as read_precision
from see2act.experiment.progress import Progress
from see2act.experiment.results import read_result
from see2act.experiment.stages.evaluate import _kept_evaluation
from see2act.experiment.stages.finetune import _attempts_in
from see2act.experiment.stages.pretrain import QUALITY
from see2act.experiment.stages.transfer import check_weights
from see2act.files import write_arrays
from see2act.modules import nanodet_weights, tfjs, weights
from see2act.modules.timm_weights import TimmWeights
from see2act.prediction.files import read_depth, read_lens, read_pose
from see2act.robot.meshes import mesh_shape
from see2act.robot.real import station
from see2act.robot.real.camera import CameraError
from see2act.robot.real.image_folder import _CutShort, _metres
from see2act.robot.real.setup.calibrate import Recording
from tests.bad_inputs.refusals import check_line, command_is_refused, is_refused


class Trap:
    """What makes a folder when it is unpickled."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[..., None], tuple[str]]:
        import os

        return os.mkdir, (str(self.marker),)


def _saved(content: object, **options: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file, **options)
    return file.getvalue()


def _arrays(trap: Trap, names: Iterable[str]) -> bytes:
    """An archive of arrays, each an object that runs code."""
    file, held = io.BytesIO(), np.array([trap], dtype=object)
    np.savez(file, allow_pickle=True, **dict.fromkeys(names, held))
    return file.getvalue()


def _array(trap: Trap) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([[trap]], dtype=object), allow_pickle=True)
    return file.getvalue()


def _zipped(trap: Trap) -> bytes:
    """What torch writes, with a pickle of one's own in it."""
    file = io.BytesIO(_saved({"state_dict": {"weight": torch.zeros(1)}}))
    parts = {name: zipfile.ZipFile(file).read(name) for name in zipfile.ZipFile(file).namelist()}
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, pickle.dumps(trap, 2) if name.endswith("data.pkl") else data)
    return made.getvalue()


def _joblib(trap: Trap) -> bytes:
    file = io.BytesIO()
    joblib.dump({"state_dict": trap}, file)
    return file.getvalue()


def _yaml(trap: Trap) -> bytes:
    return f"!!python/object/apply:os.mkdir [{json.dumps(str(trap.marker))}]\n".encode()


PICKLES: dict[str, Callable[[Trap], bytes]] = {
    "a pickle": lambda trap: pickle.dumps({"state_dict": {"weight": trap}}),
    "an old pickle": lambda trap: pickle.dumps(trap, protocol=0),
    "a packed pickle": lambda trap: gzip.compress(pickle.dumps(trap)),
    "of torch": lambda trap: _saved({"state_dict": {"weight": trap}, "network": {"weight": torch.zeros(2)}}),
    "of an old torch": lambda trap: _saved({"model": trap}, _use_new_zipfile_serialization=False),
    "of torch, changed": _zipped,
    "of joblib": _joblib,
    "an array": _array,
    "arrays": lambda trap: _arrays(trap, ("state_dict", "network", *ARRAYS, *BACKGROUND)),
    "yaml": _yaml,
}


@pytest.fixture
def marker(tmp_path: Path) -> Path:
    return tmp_path / "code was run"


@pytest.fixture(scope="module")
def configured() -> dict[str, DictConfig]:
    choices = {
        "edge": (),
        "coco": ("task=coco", "model=rpn_r50_fpn", "model.backbone=resnet18"),
        "nanodet": ("task=coco", "model=nanodet_g"),
        "timm": ("task=imagenet", "transfer=backbone", "model=timm_fpn", "model.backbone=resnet18"),
        "affordance": ("task=affordance", "task.weights=later"),
    }
    return {name: composed(["precision=fp32", *overrides]) for name, overrides in choices.items()}


def test_the_traps_work(marker: Path) -> None:
    """Or none of the tests below could fail."""
    with np.errstate(all="ignore"):
        for read in (
            lambda: pickle.loads(PICKLES["a pickle"](Trap(marker))),
            lambda: pickle.loads(PICKLES["an old pickle"](Trap(marker))),
            lambda: torch.load(io.BytesIO(PICKLES["of torch"](Trap(marker))), weights_only=False),
            lambda: torch.load(io.BytesIO(PICKLES["of an old torch"](Trap(marker))), weights_only=False),
            lambda: torch.load(io.BytesIO(PICKLES["of torch, changed"](Trap(marker))), weights_only=False),
            lambda: joblib.load(io.BytesIO(PICKLES["of joblib"](Trap(marker)))),
            lambda: np.load(io.BytesIO(PICKLES["an array"](Trap(marker))), allow_pickle=True),
            lambda: np.load(io.BytesIO(PICKLES["arrays"](Trap(marker))), allow_pickle=True)["color"],
            lambda: yaml.load(PICKLES["yaml"](Trap(marker)).decode(), yaml.UnsafeLoader),
        ):
            read()
            marker.rmdir()


@pytest.mark.parametrize("ending", [".pth", ".npz", ".safetensors", ""])
def test_weights_run_nothing_whatever_they_are_called(ending: str, tmp_path: Path, marker: Path) -> None:
    path = tmp_path / f"weights{ending}"
    for make in PICKLES.values():
        path.write_bytes(make(Trap(marker)))
        for read in (weights.read, weights.task_of, model_file.load, lambda path: load_checkpoint(path, ("state_dict",))):
            is_refused(partial(read, path), tmp_path)
        assert not model_file.is_model(path)
        assert not marker.exists()


@pytest.mark.parametrize("choice", ["edge", "coco", "nanodet", "timm", "affordance"])
@pytest.mark.parametrize("ending", [".ckpt", ".safetensors"])
def test_no_task_runs_code_in_weights(
    choice: str, ending: str, configured: dict[str, DictConfig], tmp_path: Path, marker: Path
) -> None:
    cfg, path = configured[choice].copy(), tmp_path / f"weights{ending}"
    cfg.task.weights = str(path)
    for kind in ("a pickle", "of torch", "of torch, changed", "arrays"):
        path.write_bytes(PICKLES[kind](Trap(marker)))
        is_refused(lambda: check_weights(cfg), tmp_path)
        assert not marker.exists()


def test_a_script_of_torch_is_no_state_dict(tmp_path: Path, marker: Path) -> None:
    path = tmp_path / "weights.pth"
    torch.jit.script(torch.nn.Linear(2, 2)).save(path)
    is_refused(lambda: weights.read(path), tmp_path)
    is_refused(lambda: load_checkpoint(path, ("state_dict",)), tmp_path)


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a run's last checkpoint": ("last.ckpt", _attempts_in),
    "a run's checkpoint": ("affordance.ckpt", lambda path: load_checkpoint(path, ("state_dict",))),
    "a vision model of the cache": ("v.ckpt", lambda path: load_checkpoint(path, ("task", "network", *QUALITY))),
    "a run's progress": ("progress.json", Progress.load),
    "a run's result": ("result.json", read_result),
    "an evaluation of the cache": ("e.json", _kept_evaluation),
    "a precision of the cache": ("p.json", read_precision),
    "observations of the cache": ("c.npz", Collection.load),
    "an attempt": ("finetune-00001.npz", lambda path: Records(path.parent).read("finetune-00001")),
    "an observation": ("scene-00000-000.npz", lambda path: Observations(path.parent).first(1)),
    "the empty table of observations": ("background.npz", lambda path: _with_an_observation(path.parent).first(1)),
    "the views of a calibration": ("views.npz", Recording.load),
    "a station": ("station.yaml", station.load),
    "weights of make coco": (
        str(nanodet_weights.FILE),
        lambda path: nanodet_weights.NanoDetWeights().read(None, path.parents[1]),
    ),
    "weights of timm": ("resnet18.pth", lambda path: TimmWeights("resnet18", "early").read(str(path), path.parent)),
    "a graph of TensorFlow.js": ("model.json", tfjs.read),
    "a depth image": ("depth.npy", lambda path: read_depth(path, 1.0, "--depth")),
    "intrinsics": ("intrinsics.npy", lambda path: read_lens(str(path))),
    "intrinsics in YAML": ("intrinsics.yaml", lambda path: read_lens(str(path))),
    "a pose": ("pose.npy", read_pose),
    "a pose in YAML": ("pose.yml", read_pose),
    "a mesh": ("thing.obj", lambda path: mesh_shape("thing", path, 1.0, None)),
    "a mesh of triangles": ("thing.stl", lambda path: mesh_shape("thing", path, 1.0, None)),
}
"""Name of a file, and what reads it."""


def _with_an_observation(folder: Path) -> Observations:
    maps = {"color": np.zeros((4, 4, 3), np.uint8), "height": np.zeros((4, 4), np.float32), "valid": np.ones((4, 4), bool)}
    pick = {"row": 0, "col": 0, "angle": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}
    outcome = {"success": True, "truth": None, "cause": "ok", "reading": 1.0, "robot_seconds": 1.0, "steps": 1}
    choice = {"angle": 0, "row": 0, "col": 0, "logit": 0.0, "explored": False}
    facts = np.array(json.dumps({"choice": choice, "pick": pick, "outcome": outcome, "seconds": [0.0, 0.0, 0.0]}))
    arrays = {f"map_{name}": values for name, values in maps.items()}
    write_arrays(
        folder / "scene-00000-000.npz", {"facts": facts, **arrays, "image_color": maps["color"], "image_depth": maps["height"]}
    )
    return Observations(folder)


NAMES = {
    "an attempt": ("facts", "map_color", "map_height", "map_valid", "image_color", "image_depth"),
    "the empty table of observations": ("color", "height", "valid"),
    "an observation": ("facts", "map_color", "map_height", "map_valid", "image_color", "image_depth"),
    "the views of a calibration": ("ends", "flanges", "ids", "pixels", "depth", "board", "size", "intrinsics", "serial"),
}
"""Of the arrays that a reader looks for."""


@pytest.mark.parametrize("reader", READERS)
def test_no_reader_runs_code(reader: str, tmp_path: Path, marker: Path) -> None:
    name, read = READERS[reader]
    (tmp_path / name).parent.mkdir(exist_ok=True)
    its_own = partial(_arrays, names=NAMES.get(reader, ("a",)))
    for make in (*PICKLES.values(), its_own):
        (tmp_path / name).write_bytes(make(Trap(marker)))
        is_refused(lambda: read(tmp_path / name))
        assert not marker.exists()


def test_a_camera_s_folder_runs_no_code(tmp_path: Path, marker: Path) -> None:
    for make in PICKLES.values():
        (tmp_path / "1.depth.npy").write_bytes(make(Trap(marker)))
        with pytest.raises((_CutShort, CameraError)) as told:  # it waits for the rest of a file, and is told after the timeout
            _metres(tmp_path / "1.depth.npy")
        check_line(str(told.value))
        assert not marker.exists()


@pytest.mark.parametrize("kind", ["a pickle", "of torch", "yaml"])
def test_commands_run_no_code(kind: str, tmp_path: Path, marker: Path) -> None:
    bad, run, out = tmp_path / "bad.safetensors", tmp_path / "run", tmp_path / "out"
    content = PICKLES[kind](Trap(marker))
    bad.write_bytes(content)
    for name in ("checkpoints/affordance.ckpt", ".hydra/overrides.yaml", ".hydra/config.yaml", "run.json", "attempts.csv"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_bytes(content)
    cache = f"paths.cache={tmp_path / 'cache'}"
    command_is_refused(demo.main, ["--checkpoint", str(bad), "--out", str(out), "--no-film", cache], tmp_path)
    command_is_refused(heatmaps.main, ["--run", str(run), "--out", str(out), cache], tmp_path)
    for option in ("--depth", "--color", "--intrinsics"):
        files = dict.fromkeys(("--checkpoint", "--color", "--depth", "--intrinsics"), str(bad)) | {option: str(bad)}
        arguments = [word for pair in files.items() for word in pair]
        command_is_refused(predict.main, [*arguments, "--out", str(out)], tmp_path)
    report.main([str(tmp_path)])  # of a run without a result, whatever is in its files
    assert not marker.exists()


@pytest.mark.parametrize(
    "key", ["model.network", "model.network.width", "primitive.end_effector", "primitive.end_effector.press"]
)
@pytest.mark.parametrize("listed", [False, True])
def test_a_model_cannot_have_code_in_its_configuration(key: str, listed: bool, tmp_path: Path, marker: Path) -> None:
    path, cfg = tmp_path / "model.safetensors", composed(["model.width=2", "precision=fp32"])
    network = build.network(cfg, 0)
    model_file.save(path, network, cfg)
    model_file.load(path)  # so what is refused below is the call
    content = path.read_bytes()
    metadata = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
    config = OmegaConf.create(json.loads(metadata[model_file.CONFIG]))
    call = {"_target_": "os.mkdir", "path": str(marker)}
    OmegaConf.update(config, key, [call] if listed else call, merge=False)
    metadata[model_file.CONFIG] = json.dumps(OmegaConf.to_container(config))
    path.write_bytes(serialized({name: value.contiguous() for name, value in network.state_dict().items()}, metadata))
    is_refused(lambda: model_file.load(path), tmp_path)
    assert not marker.exists()
