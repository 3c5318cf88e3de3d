from __future__ import annotations

from types import SimpleNamespace

import lightning as L
import pytest
import torch
from torch.utils.data import DataLoader

from see2act.experiment.config import composed
from see2act.modules.fcn7 import FCN7
from see2act.modules.rpn import RPN
from see2act.modules.vision import VisionBatch, VisionModule


def _module(seed: int = 0) -> VisionModule:
    torch.manual_seed(0)
    return VisionModule(FCN7(4), lr=1e-2, weight_decay=0.0, pos_weight=1.0, seed=seed)


def test_labels_turn_with_their_images() -> None:
    """Where the label is the height itself, it still is after the random turn."""
    height = torch.zeros(8, 1, 64, 64)
    height[:, :, 20:40, 25:30] = 1
    x = torch.cat([torch.zeros(8, 3, 64, 64), height], dim=1)
    turned, label = _module()._augmented(x, height[:, 0] > 0.5)
    assert torch.equal(turned[:, 3:], label)
    assert 0 < label.mean() < 0.2
    assert not torch.equal(label[0], label[1])


def test_images_turn_on_the_device_that_they_are_on() -> None:
    x, label = (t.to("meta") for t in (torch.zeros(2, 4, 32, 32), torch.zeros(2, 32, 32)))  # stands in for a GPU
    turned, turned_label = _module()._augmented(x, label)
    assert turned.device == turned_label.device == x.device


def test_augmentation_follows_its_seed() -> None:
    x, y = torch.randn(4, 4, 32, 32), torch.rand(4, 32, 32) > 0.5
    first, second, other = (_module(seed)._augmented(x, y)[0] for seed in (1, 1, 2))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_learns_to_see_what_is_high() -> None:
    module = _module()
    optimizer = torch.optim.Adam(module.network.parameters(), lr=1e-2)
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        height = torch.zeros(8, 32, 32)
        for image in height:
            r, c = torch.randint(4, 20, (2,), generator=generator)
            image[r : r + 8, c : c + 8] = 1
        x = torch.cat([torch.zeros(8, 3, 32, 32), height[:, None]], dim=1)
        loss = module.loss(module.network(x), height[:, None])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.1


def _data(count: int) -> list[VisionBatch]:
    generator = torch.Generator().manual_seed(0)
    height = torch.rand(count, 32, 32, generator=generator) * 0.1
    return [VisionBatch(torch.zeros(32, 32, 3, dtype=torch.uint8), h, h > 0.05) for h in height]


def test_each_of_several_processes_augments_by_itself() -> None:
    x, y = torch.randn(4, 4, 32, 32), torch.rand(4, 32, 32) > 0.5
    turned = []
    for rank in (0, 1, 2):
        module = _module()
        module._trainer = SimpleNamespace(global_rank=rank)  # type: ignore[assignment]
        module.on_fit_start()
        turned.append(module._augmented(x, y)[0])
    assert torch.equal(turned[0], _module()._augmented(x, y)[0])  # as one process alone
    assert not torch.equal(turned[0], turned[1])
    assert not torch.equal(turned[1], turned[2])


@pytest.mark.slow
def test_the_rpn_learns_in_several_processes_though_some_of_it_is_not_used() -> None:
    torch.manual_seed(0)
    module = VisionModule(RPN("resnet18"), lr=1e-3, weight_decay=0.0, pos_weight=1.0, seed=0)
    trainer = L.Trainer(
        **{"accelerator": "cpu", "strategy": composed(["trainer=ddp"]).trainer.strategy, "devices": 2, "max_epochs": 1},
        **{"enable_checkpointing": False, "enable_model_summary": False, "enable_progress_bar": False, "logger": False},
        num_sanity_val_steps=0,
    )
    trainer.fit(module, DataLoader(_data(8), 2), DataLoader(_data(2), 1))
    assert float(trainer.callback_metrics["vision/val_loss"]) > 0


@pytest.mark.parametrize(("strategy", "devices"), [("auto", 1), ("ddp_fork_find_unused_parameters_true", 2)])
def test_one_and_several_processes_bring_the_weights_home(strategy: str, devices: int) -> None:
    module = _module()
    before = [parameter.detach().clone() for parameter in module.parameters()]
    trainer = L.Trainer(
        **{"accelerator": "cpu", "strategy": strategy, "devices": devices, "max_epochs": 3, "logger": False},
        **{"enable_checkpointing": False, "enable_model_summary": False, "enable_progress_bar": False},
        num_sanity_val_steps=0,
    )
    trainer.fit(module, DataLoader(_data(16), 4), DataLoader(_data(4), 4))
    assert not all(torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True))
    module.eval()
    batch = next(iter(DataLoader(_data(4), 4)))
    with torch.no_grad():
        loss = module.loss(module(batch.color, batch.height), batch.label[:, None].float())
    assert loss.item() == pytest.approx(float(trainer.callback_metrics["vision/val_loss"]), rel=0.05)
