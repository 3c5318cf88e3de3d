from __future__ import annotations

import numpy as np
import pytest
import torch

from see2act.modules.affordance import AffordanceModule, AttemptBatch, Augmentation
from see2act.modules.batchnorm import batchnorms
from see2act.modules.fcn7 import FCN7
from tests.modules.make import make_module


def _module(angles: int, batchnorm: str = "frozen") -> AffordanceModule:
    torch.manual_seed(0)
    network = FCN7(4)
    torch.nn.init.normal_(network.head[-2].weight, std=0.3)
    for layer in batchnorms(network).values():
        layer.running_mean.normal_(0, 0.3)
        layer.running_var.uniform_(0.5, 2)
    network.normalization.set(torch.full((4,), 0.3), torch.full((4,), 0.5))
    return make_module(network, angles=angles, batchnorm=batchnorm)


def _batch(angles: int) -> AttemptBatch:
    g = torch.Generator().manual_seed(1)
    return AttemptBatch(
        color=torch.randint(0, 255, (6, 144, 144, 3), dtype=torch.uint8, generator=g),
        height=torch.rand(6, 144, 144, generator=g) * 0.1,
        angle=torch.randint(0, angles, (6,), generator=g),
        row=torch.tensor([0, 143, 70, 30, 90, 5]),
        col=torch.tensor([143, 3, 70, 99, 0, 5]),
        label=torch.tensor([0.0, 1, 0, 1, 1, 0]),
        weight=torch.ones(6),
        replay_index=torch.arange(6),
    )


def _varied(batch: AttemptBatch, **how: torch.Tensor) -> AttemptBatch:
    n = len(batch.label)
    nothing = {
        "mirror": torch.zeros(n, 2, dtype=torch.bool),
        "rotation": torch.zeros(n),
        "shift": torch.zeros(n, 2),
        "mixtures": torch.eye(3, 4).repeat(n, 1, 1),
    }
    return batch._replace(augmentation=Augmentation(**(nothing | how)))


@pytest.mark.parametrize(("precision", "tolerance"), [(None, 1e-4), ("fp32", 1e-4), ("bf16", 0.1)])
@pytest.mark.parametrize("angles", [1, 16])
def test_training_and_acting_see_the_same_logit(angles: int, precision: str | None, tolerance: float) -> None:
    """The pixel that the robot executes is the pixel that is trained, at the same angle and in the same frame."""
    module, batch = _module(angles), _batch(angles)
    if precision:
        module.network.set_precision(precision)
    learned = module.executed_logits(batch)
    for i in range(len(learned)):
        maps = module.affordances(batch.color[i].numpy(), batch.height[i].numpy())
        acted = maps[batch.angle[i], batch.row[i], batch.col[i]]
        assert acted == pytest.approx(learned[i].item(), abs=tolerance)


@pytest.mark.parametrize("batchnorm", ["frozen", "batch"])
@pytest.mark.parametrize("angles", [1, 16])
def test_a_mirrored_batch_is_that_of_the_mirrored_scene(angles: int, batchnorm: str) -> None:
    """A bin mirrored by columns, and the grasp with it, which then turns the other way, or half a turn on."""
    module, batch = _module(angles, batchnorm), _batch(angles)
    scene = batch._replace(
        color=batch.color.flip(2), height=batch.height.flip(2), col=143 - batch.col, angle=-batch.angle % angles
    )
    straight = batch.angle == 0
    mirrored = _varied(batch, mirror=torch.stack([~straight, straight], dim=1))  # half a turn exchanges the two
    expected = module.executed_logits(scene)
    assert torch.allclose(module.executed_logits(mirrored), expected, atol=1e-3)
    assert not torch.allclose(module.executed_logits(batch), expected, atol=1e-2)


@pytest.mark.parametrize("angles", [1, 16])
def test_window_gives_the_gradient_of_the_whole_heightmap(angles: int) -> None:
    module, batch = _module(angles), _batch(angles)
    module.train()
    module.training_step(batch, 0)["loss"].backward()
    window = {k: p.grad.clone() for k, p in module.network.named_parameters()}
    module.zero_grad()
    x, turns = module.network.prepare(batch.color, batch.height), module.rotations
    rows, cols = turns.locate(batch.angle, batch.row, batch.col)
    logits = []
    for i, angle in enumerate(batch.angle):
        whole = turns.turned(x[i : i + 1], angle[None], turns.canvases[angle])
        logits.append(module.network(whole)[0, 0, rows[i], cols[i]])
    logits = torch.stack(logits)
    torch.nn.functional.binary_cross_entropy_with_logits(logits, batch.label).backward()
    for key, parameter in module.network.named_parameters():
        scale = parameter.grad.abs().max()
        assert (window[key] - parameter.grad).abs().max() <= 1e-4 * scale, key


def test_loss_is_cross_entropy_of_the_executed_pixel_only() -> None:
    module, batch = _module(1), _batch(1)
    logits = module.executed_logits(batch)
    p = torch.sigmoid(logits)
    expected = -(batch.label * p.log() + (1 - batch.label) * (1 - p).log()).mean()
    outputs = module.training_step(batch, 0)
    assert torch.allclose(outputs["loss"], expected)
    assert torch.allclose(outputs["td_error"], (p - batch.label).abs())
    assert not outputs["td_error"].requires_grad


def test_acting_changes_nothing() -> None:
    module = _module(16, "batch")
    module.train()
    before = {k: v.clone() for k, v in module.state_dict().items()}
    maps = module.affordances(np.zeros((144, 144, 3), np.uint8), np.zeros((144, 144), np.float32))
    assert maps.shape == (16, 144, 144)
    assert module.training
    assert all(torch.equal(v, before[k]) for k, v in module.state_dict().items())


@pytest.mark.parametrize(("batchnorm", "moves"), [("frozen", False), ("batch", True)])
def test_batchnorm_modes(batchnorm: str, moves: bool) -> None:
    module = _module(1, batchnorm)
    module.train()
    layer = next(iter(batchnorms(module.network).values()))
    before = layer.running_mean.clone()
    module.training_step(_batch(1), 0)
    assert torch.equal(layer.running_mean, before) is not moves


def test_learning_moves_each_tried_pixel_towards_its_outcome() -> None:
    module, batch = _module(16), _batch(16)
    optimizer = torch.optim.Adam(module.parameters(), 3e-3)
    module.train()
    for _ in range(80):
        optimizer.zero_grad()
        module.training_step(batch, 0)["loss"].backward()
        optimizer.step()
        module.on_train_batch_end()
    assert torch.equal(module.executed_logits(batch) > 0, batch.label > 0.5)


def test_backbone_and_head_have_their_own_rates() -> None:
    module = make_module(FCN7(4), backbone_lr=1e-5, head_lr=1e-3)
    groups = module.configure_optimizers()["optimizer"].param_groups
    assert [group["lr"] for group in groups] == [1e-5, 1e-3]
    assert sum(len(group["params"]) for group in groups) == len(list(module.network.parameters()))


def test_the_average_acts_and_the_last_parameters_learn() -> None:
    module = _module(1)
    assert module.acting is module.network
    head = module.network.head[-2]
    for value in (1.0, 3.0):
        torch.nn.init.constant_(head.bias, value)
        module.on_train_batch_end()
    assert module.acting.head[-2].bias.item() == pytest.approx(0.9 * 1 + 0.1 * 3)
    scene = np.zeros((144, 144, 3), np.uint8), np.zeros((144, 144), np.float32)
    averaged = module.affordances(*scene)
    module.average.module.load_state_dict(module.network.state_dict())
    assert module.affordances(*scene) == pytest.approx(averaged + 1.8, abs=1e-4)
    module.training_step(_batch(1), 0)["loss"].backward()
    assert all(p.grad is not None for p in module.network.parameters())
    assert all(p.grad is None for p in module.average.parameters())


def test_the_rates_rise_over_the_first_steps() -> None:
    configured = make_module(FCN7(4), backbone_lr=1e-5, head_lr=1e-3, lr_warmup=4).configure_optimizers()
    optimizer, schedule = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    assert configured["lr_scheduler"]["interval"] == "step"
    rates = []
    for _ in range(6):
        rates.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        schedule.step()
    assert rates == [[pytest.approx(share * rate) for rate in (1e-5, 1e-3)] for share in (0.25, 0.5, 0.75, 1, 1, 1)]


def test_the_average_is_short_at_first() -> None:
    """After n steps it keeps (1 + n) / (10 + n) of itself, and at most its decay."""
    module = make_module(FCN7(4), averaging=0.25, averaging_warmup=10)
    bias, expected = module.network.head[-2].bias, 0.0
    for n, kept in enumerate((0.0, 2 / 11, 3 / 12, 0.25, 0.25)):
        torch.nn.init.constant_(bias, n)
        module.on_train_batch_end()
        expected = kept * expected + (1 - kept) * n
        assert module.acting.head[-2].bias.item() == pytest.approx(expected)


def test_statistics_are_averaged_with_the_parameters_they_belong_to() -> None:
    module = _module(1)
    mean = next(m for m in module.network.modules() if isinstance(m, torch.nn.BatchNorm2d)).running_mean
    for value in (1.0, 3.0):
        mean.fill_(value)
        module.on_train_batch_end()
    averaged = next(m for m in module.acting.modules() if isinstance(m, torch.nn.BatchNorm2d)).running_mean
    assert averaged == pytest.approx(0.9 * 1 + 0.1 * 3)


def test_color_jitter_mixes_channels() -> None:
    module, batch = _module(1), _batch(1)
    swapped = batch._replace(color=(batch.color.flip(3).float() * 0.5).round().to(torch.uint8))
    mixtures = torch.zeros(6, 3, 4)
    mixtures[:, [0, 1, 2], [2, 1, 0]] = 0.5
    jittered = module.executed_logits(_varied(batch, mixtures=mixtures))
    assert torch.allclose(jittered, module.executed_logits(swapped), atol=1e-4)
    white = batch._replace(color=torch.full_like(batch.color, 255))
    mixtures[:, :, 3] = 2.0
    jittered = module.executed_logits(_varied(batch, mixtures=mixtures))
    assert torch.allclose(jittered, module.executed_logits(white), atol=1e-4)
