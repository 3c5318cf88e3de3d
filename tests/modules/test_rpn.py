"""Against torchvision's own detector, in its true layout; the values are random, nothing is downloaded."""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from safetensors.torch import save_file
from torch import Tensor
from torchvision.models import mobilenet_v3_large, resnet18, resnet50
from torchvision.models.detection import FasterRCNN, fasterrcnn_resnet50_fpn
from torchvision.models.detection._utils import overwrite_eps
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import _mobilenet_extractor, _resnet_fpn_extractor
from torchvision.ops import FrozenBatchNorm2d

from see2act.errors import TransferError
from see2act.experiment.config import composed
from see2act.modules.batchnorm import batchnorms
from see2act.modules.rpn import MOBILENET, RPN, enlarged
from see2act.modules.transfer import AVERAGE, copy_parts
from see2act.modules.weights import Torchvision, read, to_our_keys
from tests.modules.make import make_module

MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
SHELF = {"coco": Torchvision("fasterrcnn_resnet50_fpn.COCO_V1", MEAN, STD, 0.0)}
SHELF["imagenet"] = Torchvision("resnet50.IMAGENET1K_V1", MEAN, STD, 1e-5)
ZERO = ["backbone.depth"]


@pytest.fixture(scope="module")
def detector() -> FasterRCNN:
    """As torchvision builds it for COCO_V1: BatchNorm frozen, epsilon 0, here with statistics that are not trivial."""
    torch.manual_seed(0)
    body = resnet50(weights=None, norm_layer=FrozenBatchNorm2d)
    model = FasterRCNN(_resnet_fpn_extractor(body, 5), 91).eval()
    overwrite_eps(model, 0.0)
    layers = [layer for layer in model.modules() if isinstance(layer, FrozenBatchNorm2d)]
    assert len(layers) == 53
    for layer in layers:
        layer.running_mean.normal_(0, 0.1)
        layer.running_var.uniform_(0.5, 2)
    return model


def _with_height(state: dict[str, Tensor]) -> dict[str, Tensor]:
    for name, value in (("normalization.mean", 0.02), ("normalization.std", 0.03)):
        state[name] = torch.cat([state[name], torch.tensor([value])])
    return state


def _old(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The layout of torchvision before 0.13."""
    return {re.sub(r"(fpn\.\w+_blocks\.\d|rpn\.head\.conv)(\.0)+\.", r"\1.", key): value for key, value in state.items()}


def _save_pth(state: dict[str, Tensor], folder: Path) -> Path:
    torch.save(state, folder / "weights.pth")
    return folder / "weights.pth"


def _save_safetensors(state: dict[str, Tensor], folder: Path) -> Path:
    save_file(state, folder / "weights.safetensors")
    return folder / "weights.safetensors"


@pytest.mark.parametrize("save", [_save_pth, _save_safetensors])
@pytest.mark.parametrize("layout", [dict, _old])
def test_rgbd_input_gives_the_detector_s_objectness_on_rgb(
    detector: FasterRCNN, save: Callable, layout: Callable, tmp_path: Path
) -> None:
    state = layout(detector.state_dict())
    assert ("rpn.head.conv.weight" in state) == (layout is _old)
    source = _with_height(SHELF["coco"].read(str(save(state, tmp_path)), tmp_path))
    network = RPN().eval()
    report = copy_parts(source, network, ["backbone", "head"], zero=ZERO)
    # In double precision: how much of single precision fifty layers lose depends on the processor.
    network, exact = network.double(), copy.deepcopy(detector).double()
    assert set(report.set_to_zero) == {"backbone.depth.weight"}
    assert set(report.left_at_initialisation) == {AVERAGE}
    assert report.unused
    assert all(key.startswith("roi_heads") for key in report.unused)

    color = torch.randint(0, 256, (1, 256, 320, 3), dtype=torch.uint8)
    image = exact.transform.normalize(color[0].permute(2, 0, 1).double() / 255)[None]
    with torch.no_grad():
        objectness, _ = exact.rpn.head([exact.backbone(image)["0"]])
        expected = objectness[0].amax(1, keepdim=True)
        for height in (torch.zeros(1, 256, 320), torch.rand(1, 256, 320)):
            ours = network(network.prepare(color, height.double()))
            assert (ours[..., ::4, ::4] - expected).abs().max() <= 1e-6
    assert expected.std() > 1e-3


def test_it_equals_the_detector_that_torchvision_builds_untrained(tmp_path: Path) -> None:
    """Which has plain BatchNorm with epsilon 1e-5, and keys for its counters."""
    torch.manual_seed(2)
    model = fasterrcnn_resnet50_fpn(weights=None, weights_backbone=None).eval()
    shelf = replace(SHELF["coco"], epsilon=1e-5)
    network = RPN().eval()
    copy_parts(
        _with_height(shelf.read(str(_save_pth(model.state_dict(), tmp_path)), tmp_path)),
        network,
        ["backbone", "head"],
        zero=ZERO,
    )
    network, model = network.double(), model.double()
    color = torch.randint(0, 256, (1, 128, 128, 3), dtype=torch.uint8)
    image = model.transform.normalize(color[0].permute(2, 0, 1).double() / 255)[None]
    with torch.no_grad():
        objectness, _ = model.rpn.head([model.backbone(image)["0"]])
        ours = network(network.prepare(color, torch.rand(1, 128, 128).double()))
    assert (ours[..., ::4, ::4] - objectness[0].amax(1, keepdim=True)).abs().max() <= 1e-6


def test_a_mobilenet_gives_its_detector_s_objectness(tmp_path: Path) -> None:
    """As torchvision builds it for COCO_V1: frozen BatchNorm, whose epsilon is not that of the classifier."""
    torch.manual_seed(5)
    body = mobilenet_v3_large(weights=None, norm_layer=FrozenBatchNorm2d)
    sizes = 3 * ((32, 64, 128, 256, 512),)
    anchors = AnchorGenerator(sizes, 3 * ((0.5, 1.0, 2.0),))
    detector = FasterRCNN(_mobilenet_extractor(body, True, 6), 91, rpn_anchor_generator=anchors).eval()
    for layer in detector.modules():
        if isinstance(layer, FrozenBatchNorm2d):
            layer.running_mean.normal_(0, 0.1)
            layer.running_var.uniform_(0.001, 2)
    shelf = instantiate(
        composed(["model=rpn_r50_fpn", f"model.backbone={MOBILENET}", "task=coco"]).task.off_the_shelf.rpn_r50_fpn
    )
    network = RPN(MOBILENET).eval()
    source = _with_height(shelf.read(str(_save_pth(detector.state_dict(), tmp_path)), tmp_path))
    report = copy_parts(source, network, ["backbone", "head"], zero=ZERO)
    assert set(report.set_to_zero) == {"backbone.depth.weight"}
    assert set(report.left_at_initialisation) == {AVERAGE}
    network, exact = network.double(), detector.double()
    color = torch.randint(0, 256, (1, 256, 320, 3), dtype=torch.uint8)
    image = exact.transform.normalize(color[0].permute(2, 0, 1).double() / 255)[None]
    with torch.no_grad():
        objectness, _ = exact.rpn.head([exact.backbone(image)["0"]])
        ours = network(network.prepare(color, torch.rand(1, 256, 320).double()))
    expected = objectness[0].amax(1, keepdim=True).float()
    assert (ours[..., ::32, ::32] - expected).abs().max() < 1e-4 * expected.std()


def test_a_mobilenet_that_classifies_gives_the_body_alone(tmp_path: Path) -> None:
    torch.manual_seed(6)
    classifier = mobilenet_v3_large(weights=None).eval()
    shelf = instantiate(
        composed(["model=rpn_r50_fpn", f"model.backbone={MOBILENET}", "task=imagenet"]).task.off_the_shelf.rpn_r50_fpn
    )
    network = RPN(MOBILENET).eval()
    source = _with_height(shelf.read(str(_save_pth(classifier.state_dict(), tmp_path)), tmp_path))
    report = copy_parts(source, network, ["backbone"], ["backbone.fpn"], ZERO)
    assert {key.split(".")[0] for key in report.unused} == {"classifier"}
    x = torch.randn(1, 3, 64, 96)
    ours, theirs = x, classifier.features(x)
    for layer in network.backbone.body.values():
        ours = layer(ours)
    torch.testing.assert_close(ours, theirs)


def test_a_classifier_gives_the_body_alone(tmp_path: Path) -> None:
    torch.manual_seed(1)
    classifier = resnet50(weights=None).eval()
    source = _with_height(SHELF["imagenet"].read(str(_save_pth(classifier.state_dict(), tmp_path)), tmp_path))
    network = RPN().eval()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    report = copy_parts(source, network, ["backbone"], ["backbone.fpn"], ZERO)
    assert set(report.unused) == {"fc.weight", "fc.bias"}
    for key, value in network.state_dict().items():
        expected = torch.zeros_like(value) if key in report.set_to_zero else before[key]
        assert torch.equal(value, source[key] if key in report.copied else expected), key
    assert set(report.set_to_zero) == {"backbone.depth.weight"}
    x = torch.randn(1, 4, 64, 64)
    with torch.no_grad():
        ours, theirs = x[:, :3], x[:, :3]
        for name, layer in network.backbone.body.items():
            ours, theirs = layer(ours), getattr(classifier, name)(theirs)
    assert torch.allclose(ours, theirs, atol=1e-5)


def test_a_backbone_by_itself_is_recognised(detector: FasterRCNN, tmp_path: Path) -> None:
    source = SHELF["coco"].read(str(_save_pth(detector.backbone.state_dict(), tmp_path)), tmp_path)
    report = copy_parts(_with_height(source), RPN(), ["backbone"], zero=ZERO)
    assert len(report.copied) > 300


def test_epsilon_travels_with_the_weights(detector: FasterRCNN, tmp_path: Path) -> None:
    source = _with_height(SHELF["coco"].read(str(_save_pth(detector.state_dict(), tmp_path)), tmp_path))
    first, second = RPN().eval(), RPN().eval()
    copy_parts(source, first, ["backbone", "head"], zero=ZERO)
    copy_parts(first.state_dict(), second, ["backbone", "head"])
    x = torch.randn(1, 4, 64, 64)
    assert torch.equal(first(x), second(x))
    assert {layer.eps for layer in batchnorms(second).values()} == {0.0}


def test_a_logit_of_one_pixel_is_that_of_the_whole_map() -> None:
    torch.manual_seed(3)
    network = RPN("resnet18").eval()
    x = torch.randn(5, 4, 96, 128)
    row, col = torch.tensor([0, 95, 50, 3, 94]), torch.tensor([0, 127, 61, 126, 2])
    gradients = []
    for logits in (network(x)[torch.arange(5), 0, row, col], network.logits_at(x, row, col)):
        network.zero_grad()
        logits.sum().backward()
        gradients.append(
            (logits.detach(), {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None})
        )
    (whole, expected), (alone, ours) = gradients
    assert torch.allclose(whole, alone, atol=1e-5)
    assert ours.keys() == expected.keys()
    for name, gradient in expected.items():
        assert torch.allclose(gradient, ours[name], atol=1e-5 + 1e-3 * float(gradient.abs().max())), name


def test_logits_lie_over_what_they_were_computed_from() -> None:
    """The pixels that move a logit are centred on it; half a stride beside it they would be 1.5 px off."""
    torch.manual_seed(4)
    stem = RPN("resnet18").eval().backbone.body
    pixels = torch.zeros(64, 64, 2)
    pixels[..., 0], pixels[..., 1] = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    for row, col in ((32, 32), (30, 35)):
        x = torch.zeros(8, 3, 64, 64, requires_grad=True)
        y = x + torch.randn(8, 3, 64, 64)
        for name in ("conv1", "bn1", "relu", "maxpool", "layer1"):
            y = stem[name](y)
        enlarged(y, 4)[:, :, row, col].square().sum().backward()
        weight = x.grad.abs().sum((0, 1))
        centre = (pixels * weight[..., None]).sum((0, 1)) / weight.sum()
        assert (centre - torch.tensor([float(row), float(col)])).abs().max() < 0.75


def test_features_are_enlarged_linearly_between_their_centres() -> None:
    x = torch.tensor([[[[0.0, 4.0], [8.0, 12.0]]]])
    assert enlarged(x, 4)[0, 0, 0].tolist() == [0, 1, 2, 3, 4, 4, 4, 4]
    assert enlarged(x, 4)[0, 0, :, 4].tolist() == [4, 6, 8, 10, 12, 12, 12, 12]


@pytest.mark.parametrize("name", ["resnet18", "resnet34"])
def test_smaller_backbones_have_the_same_interface(name: str) -> None:
    network = RPN(name).eval()
    assert network(torch.randn(2, 4, 144, 160)).shape == (2, 1, 144, 160)
    module = make_module(network, angles=16)
    assert module.rotations.canvases == 16 * [(224, 224)]


def test_the_depth_can_be_learned_and_left_out() -> None:
    network = RPN("resnet18")
    network(torch.randn(2, 4, 64, 64)).sum().backward()
    assert network.backbone.depth.weight.grad.abs().max() > 0
    first = network.backbone.body.conv1.weight.std()
    assert 0.8 < network.backbone.depth.weight.std() / first < 1.25  # scratch sees depth as well as colour
    blind = RPN("resnet18", depth="none").eval()
    x = torch.randn(1, 4, 64, 64)
    assert torch.equal(blind(x), blind(torch.cat([x[:, :3], x[:, 3:] + 1], 1)))
    with pytest.raises(ValueError, match="depth=late"):
        RPN("resnet18", depth="late")


class _Evil:
    def __reduce__(self) -> tuple:
        return (Path.write_text, (Path("pwned"), "ran"))


def test_files_that_cannot_be_trusted_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.pth").write_bytes(pickle.dumps({"a": _Evil()}))
    torch.save({"a": _Evil()}, tmp_path / "evil2.pth")
    whole = _save_pth(resnet18(weights=None).state_dict(), tmp_path).read_bytes()
    (tmp_path / "cut.pth").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "cut.safetensors").write_bytes(b"\x08")
    torch.save([1, 2], tmp_path / "list.pth")
    for name in ("evil.pth", "evil2.pth", "cut.pth", "cut.safetensors", "list.pth", "none.pth"):
        with pytest.raises(TransferError, match=name.replace(".", r"\.")):
            read(tmp_path / name)
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("share", [0.001, 0.5, 0.95, 0.999])
def test_a_file_that_was_cut_short_is_refused_whatever_its_format(tmp_path: Path, share: float) -> None:
    for zipped in (False, True):
        torch.save({"a": torch.zeros(500), "b": torch.ones(3)}, tmp_path / "w.pth", _use_new_zipfile_serialization=zipped)
        whole = (tmp_path / "w.pth").read_bytes()
        (tmp_path / "w.pth").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(TransferError, match=r"w\.pth cannot be read"):
            read(tmp_path / "w.pth")


def test_a_checkpoint_with_an_object_in_it_says_how_to_do_without(tmp_path: Path) -> None:
    torch.save({"state_dict": {"a": torch.zeros(1)}, "callbacks": {Path: 1}}, tmp_path / "old.ckpt")
    with pytest.raises(TransferError, match=r"holds a pathlib\.Path.*save its state dict alone") as error:
        read(tmp_path / "old.ckpt")
    assert "\x1b" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_damaged_file_in_torchvision_s_cache_is_refused_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.hub.get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "resnet50-0676ba61.pth").write_bytes(pickle.dumps({"a": _Evil()}))
    with pytest.raises(TransferError, match="is damaged, its sha256 does not begin with 0676ba61"):
        SHELF["imagenet"].read(None, tmp_path)
    assert not (tmp_path / "pwned").exists()


def test_a_detector_of_one_s_own_keeps_its_epsilon(tmp_path: Path) -> None:
    """Its BatchNorm was not frozen, unlike that of torchvision's."""
    shelf = replace(SHELF["coco"], epsilon=1e-5, epsilon_of={"fasterrcnn_resnet50_fpn": 0.0})
    body = {"conv1.weight": torch.zeros(64, 3, 7, 7), "bn1.running_mean": torch.zeros(64)}
    frozen = shelf.read(str(_save_pth(body, tmp_path)), tmp_path)
    own = shelf.read(str(_save_pth(body | {"bn1.num_batches_tracked": torch.tensor(7)}, tmp_path)), tmp_path)
    assert float(frozen["backbone.body.bn1.epsilon"]) == 0
    assert float(own["backbone.body.bn1.epsilon"]) == pytest.approx(1e-5)


def test_another_architecture_and_another_anchor_count_are_refused(detector: FasterRCNN, tmp_path: Path) -> None:
    small = _with_height(SHELF["imagenet"].read(str(_save_pth(resnet18(weights=None).state_dict(), tmp_path)), tmp_path))
    with pytest.raises(TransferError, match=r"backbone\.body\.layer1\.0\.conv3\.weight is missing.* more"):
        copy_parts(small, RPN(), ["backbone"], ["backbone.fpn"], ZERO)
    source = _with_height(SHELF["coco"].read(str(_save_pth(detector.state_dict(), tmp_path)), tmp_path))
    with pytest.raises(TransferError, match=r"head\.cls_logits\.weight is \[3, 256, 1, 1\] there and \[5, 256, 1, 1\]"):
        copy_parts(source, RPN(anchors=5), ["backbone", "head"], zero=ZERO)
    with pytest.raises(TransferError, match="nothing of it is called backbone"):
        copy_parts(
            {name: torch.zeros(4) for name in ("normalization.mean", "normalization.std")}, RPN(), ["backbone"], ["backbone"]
        )


def test_without_a_network_the_mend_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def offline(*_: object, **__: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", offline)
    with pytest.raises(TransferError, match=r"bring fasterrcnn_resnet50_fpn_coco-258fb6c6\.pth .* task\.weights=FILE"):
        SHELF["coco"].read(None, tmp_path)


def test_a_detector_that_torchvision_does_not_have_is_refused(tmp_path: Path) -> None:
    shelf = replace(SHELF["coco"], weights="fasterrcnn_resnet18_fpn.COCO_V1")
    with pytest.raises(TransferError, match=r"has no fasterrcnn_resnet18_fpn.*resnet50 or mobilenet_v3_large"):
        shelf.read(None, tmp_path)
    with pytest.raises(ValueError, match=r"model\.backbone=resnet is unknown"):
        RPN("resnet")


def test_keys_of_this_project_stay_as_they_are() -> None:
    state = RPN("resnet18").state_dict()
    assert set(to_our_keys(state)) == set(state)
