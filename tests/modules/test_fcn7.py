from __future__ import annotations

import pytest
import torch

from see2act.modules.batchnorm import batchnorms, estimate, freeze
from see2act.modules.fcn7 import FCN7
from see2act.modules.rpn import RPN


@pytest.fixture
def network() -> FCN7:
    torch.manual_seed(0)
    return FCN7(8)


@pytest.mark.parametrize("shape", [(144, 144), (208, 288), (204, 204)])
def test_one_logit_a_pixel(network: FCN7, shape: tuple[int, int]) -> None:
    assert network.eval()(torch.randn(2, 4, *shape)).shape == (2, 1, *shape)


def test_backbone_has_seven_convolutions_at_stride_four(network: FCN7) -> None:
    kernels = [m for m in network.backbone.modules() if isinstance(m, torch.nn.Conv2d) and m.kernel_size == (3, 3)]
    assert len(kernels) == 7
    assert network.backbone(torch.randn(1, 4, 144, 144)).shape == (1, 64, 36, 36)


def test_width_64_is_the_paper_s() -> None:
    assert [m.num_features for m in batchnorms(FCN7(64)).values()] == [
        64,
        128,
        128,
        256,
        256,
        512,
        512,
        256,
        256,
        128,
        128,
        64,
        64,
    ]


def test_the_receptive_radius_covers_everything_a_logit_depends_on(network: FCN7) -> None:
    torch.nn.init.normal_(network.head[-2].weight)
    x = torch.randn(1, 4, 200, 200, requires_grad=True)
    network.eval()(x)[0, 0, 101, 98].backward()
    rows, cols = x.grad.abs().sum((0, 1)).nonzero().T
    far = max((rows - 101).abs().max(), (cols - 98).abs().max()).item()
    assert network.receptive_radius - 8 <= far <= network.receptive_radius


def test_a_new_head_starts_undecided(network: FCN7) -> None:
    probability = torch.sigmoid(network.train()(torch.randn(4, 4, 144, 144)))
    assert (probability - 0.5).abs().max() < 0.2


def test_golden_output() -> None:
    """Changes of the architecture or of its initialisation change published numbers: then change this one too."""
    torch.manual_seed(0)
    network = FCN7(4).eval()
    x = torch.linspace(-1, 1, 4 * 16 * 16).reshape(1, 4, 16, 16)
    assert network(x).mean().item() == pytest.approx(GOLDEN, rel=1e-4)


GOLDEN = 0.00624466


def test_prepared_input_is_normalised(network: FCN7) -> None:
    network.normalization.set(torch.tensor([0.2, 0.4, 0.6, 0.01]), torch.tensor([0.1, 0.2, 0.3, 0.02]))
    color = torch.tensor([51, 102, 153], dtype=torch.uint8).expand(1, 8, 8, 3)
    x = network.prepare(color, torch.full((1, 8, 8), 0.03))
    assert torch.allclose(x[0, :, 0, 0], torch.tensor([0, 0, 0, 1.0]), atol=1e-6)


def test_estimated_statistics_are_those_of_the_inputs(network: FCN7) -> None:
    inputs = [torch.randn(4, 4, 32, 32) * 3 + 1 for _ in range(5)]
    first = next(iter(batchnorms(network)))
    others = {n: m.running_var.clone() for n, m in batchnorms(network).items() if n != first}
    network.eval()
    estimate(network, inputs, [first])
    layer = batchnorms(network)[first]
    seen = torch.cat([network.backbone[0](x) for x in inputs])
    assert torch.allclose(layer.running_mean, seen.mean((0, 2, 3)), atol=1e-4)
    assert torch.allclose(layer.running_var, seen.var((0, 2, 3)), rtol=2e-2)
    assert all(torch.equal(batchnorms(network)[n].running_var, v) for n, v in others.items())
    assert not network.training
    assert layer.momentum == 0.1


def test_frozen_batchnorm_stays(network: FCN7) -> None:
    network.train()
    freeze(network)
    before = {n: m.running_mean.clone() for n, m in batchnorms(network).items()}
    network(torch.randn(4, 4, 32, 32))
    assert all(torch.equal(m.running_mean, before[n]) for n, m in batchnorms(network).items())
    assert network.training


@pytest.mark.parametrize("side", [100, 144, 204])
def test_one_logit_is_that_of_the_whole_map(network: FCN7, side: int) -> None:
    torch.nn.init.normal_(network.head[-2].weight)
    x = torch.randn(4, 4, side, side)
    row, col = torch.tensor([[0, side - 1], [side // 2, side // 2 + 1], [77, 78], [side - 3, 50]]).T
    with torch.no_grad():
        whole = network.eval()(x)[torch.arange(4), 0, row, col]
        assert torch.allclose(network.logits_at(x, row, col), whole, atol=1e-4 * float(whole.std()))


def test_an_unknown_precision_is_refused(network: FCN7) -> None:
    with pytest.raises(ValueError, match="precision=bf-16"):
        network.set_precision("bf-16")


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_the_fast_way_gives_the_same_logits(network: FCN7, precision: str) -> None:
    torch.nn.init.normal_(network.head[-2].weight)
    x = torch.randn(2, 4, 64, 64)
    with torch.no_grad():
        plain = network.eval()(x)
        network.set_precision(precision)
        fast = network(x)
    assert fast.dtype == torch.float32
    tolerance = {"fp32": 1e-5, "bf16": 0.02}[precision]
    assert (fast - plain).std() < tolerance * plain.std()


@pytest.mark.parametrize("model", [FCN7(4), RPN("resnet18")])
def test_scaled_logits_are_less_sure_of_the_same(model: FCN7 | RPN) -> None:
    x = torch.randn(1, 4, 64, 64)
    with torch.no_grad():
        before = model.eval()(x)
        model.scale_logits(0.25)
        assert torch.allclose(model(x), 0.25 * before, atol=1e-6)


def test_large_logits_stay_apart_in_bfloat16(network: FCN7) -> None:
    """bfloat16 knows no number between 64 and 64.5: of equal logits the policy would take the one in the corner."""
    network.set_precision("bf16")
    torch.nn.init.constant_(network.head[-2].bias, 64.0)
    with torch.no_grad():
        logits = network.eval()(torch.randn(1, 4, 64, 64))
    assert len(logits.unique()) > 0.9 * logits.numel()
