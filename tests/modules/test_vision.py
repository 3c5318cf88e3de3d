from __future__ import annotations

import torch
from see2act.modules.fcn7 import FCN7
from see2act.modules.vision import VisionModule


def _module(seed: int = 0) -> VisionModule:
    torch.manual_seed(0)
    return VisionModule(FCN7(4), lr=1e-2, weight_decay=0.0, pos_weight=1.0, steps=60, seed=seed)


def test_labels_turn_with_their_images() -> None:
    """Where the label is the height itself, it still is after the random turn."""
    height = torch.zeros(8, 1, 64, 64)
    height[:, :, 20:40, 25:30] = 1
    x = torch.cat([torch.zeros(8, 3, 64, 64), height], dim=1)
    turned, label = _module()._turn(x, height[:, 0] > 0.5)
    assert torch.equal(turned[:, 3:], label)
    assert 0 < label.mean() < 0.2
    assert not torch.equal(label[0], label[1])


def test_augmentation_follows_its_seed() -> None:
    x, y = torch.randn(4, 4, 32, 32), torch.rand(4, 32, 32) > 0.5
    first, second, other = (_module(seed)._turn(x, y)[0] for seed in (1, 1, 2))
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
