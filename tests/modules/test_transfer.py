from __future__ import annotations

import pytest
import torch

from see2act.errors import TransferError
from see2act.modules.fcn7 import FCN7
from see2act.modules.rotation import Rotations
from see2act.modules.transfer import AVERAGE, copy_parts


def _network(seed: int, width: int = 4) -> FCN7:
    torch.manual_seed(seed)
    network = FCN7(width)
    network.normalization.set(torch.full((4,), float(seed)), torch.full((4,), 2.0))
    return network


@pytest.mark.parametrize("parts", [["backbone"], ["backbone", "head"]])
def test_parts_are_copied_and_the_rest_is_not(parts: list[str]) -> None:
    source, target = _network(1), _network(2)
    before = {k: v.clone() for k, v in target.state_dict().items()}
    report = copy_parts(source.state_dict(), target, parts)
    for key, value in target.state_dict().items():
        part = key.split(".")[0]
        expected = source.state_dict()[key] if part in (*parts, "normalization") else before[key]
        assert torch.equal(value, expected), key
        assert (key in report.copied) == (part in (*parts, "normalization"))
    assert set(report.copied) | set(report.left_at_initialisation) == set(before)
    assert set(report.unused) == {k for k in source.state_dict() if k not in report.copied}
    assert report.copied["backbone.0.weight"] == [4, 4, 3, 3]


def test_nothing_is_copied_for_the_baseline() -> None:
    target = _network(2)
    before = {k: v.clone() for k, v in target.state_dict().items()}
    report = copy_parts({}, target, [])
    assert not report.copied
    assert all(torch.equal(v, before[k]) for k, v in target.state_dict().items())


def test_a_full_transfer_gives_the_source_s_output() -> None:
    source, target = _network(1).eval(), _network(2).eval()
    copy_parts(source.state_dict(), target, ["backbone", "head"])
    x = torch.randn(1, 4, 32, 32)
    assert torch.equal(source(x), target(x))


def test_beyond_a_turned_heightmap_lies_the_average_pixel_whatever_the_weights_learned_from() -> None:
    photographs = {key: value for key, value in _network(1).state_dict().items() if key != AVERAGE}
    network = _network(2)
    report = copy_parts(photographs, network, ["backbone", "head"])
    assert list(report.left_at_initialisation) == [AVERAGE]
    network.normalization.average.copy_(torch.tensor([51 / 255, 102 / 255, 153 / 255, 0.03]))
    color = torch.tensor([51, 102, 153], dtype=torch.uint8).expand(1, 32, 32, 3)
    prepared = network.prepare(color, torch.full((1, 32, 32), 0.03))
    rotations = Rotations((32, 32), 4, network.stride, network.receptive_radius)
    seen = network.entering(rotations.turned(prepared, torch.tensor([1])))
    assert seen.shape[2] > 32  # with room beyond the corners
    expected = (network.normalization.average - network.normalization.mean) / network.normalization.std
    torch.testing.assert_close(seen, expected[:, None, None].expand_as(seen))


def test_another_width_is_refused_with_keys_and_shapes() -> None:
    target = _network(2)
    before = {k: v.clone() for k, v in target.state_dict().items()}
    with pytest.raises(
        TransferError, match=r"backbone\.0\.weight is \[8, 4, 3, 3\] there and \[4, 4, 3, 3\] here.*model\.width"
    ):
        copy_parts(_network(1, 8).state_dict(), target, ["backbone", "head"])
    assert all(torch.equal(v, before[k]) for k, v in target.state_dict().items())


def test_missing_and_foreign_keys_are_refused() -> None:
    source = {k: v for k, v in _network(1).state_dict().items() if k != "head.4.bias"}
    with pytest.raises(TransferError, match=r"head\.4\.bias is missing"):
        copy_parts(source, _network(2), ["backbone", "head"])
    source = {**_network(1).state_dict(), "backbone.99.weight": torch.zeros(1)}
    with pytest.raises(TransferError, match=r"backbone\.99\.weight is not in this network"):
        copy_parts(source, _network(2), ["backbone"])
