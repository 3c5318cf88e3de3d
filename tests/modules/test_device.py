"""Deciding and learning on another device than the processor: tensors that claim to be on a GPU, and are on none."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from lightning.pytorch.utilities import move_data_to_device
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from see2act.modules import fcn7, rpn
from see2act.modules.affordance import AttemptBatch, Augmentation, turned_logits
from see2act.modules.batchnorm import BatchNorm
from see2act.modules.color_jitter import random_mixtures
from see2act.modules.network import PixelNetwork
from tests.modules.make import make_module

SHAPE = (64, 64)
CUDA = torch.device("cuda:0")
NETWORKS = {"fcn7": lambda: fcn7.FCN7(width=4), "rpn": lambda: rpn.RPN("resnet18")}


@pytest.fixture(autouse=True)
def tensors_without_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a crop begins is read from its tensor, as is BatchNorm's epsilon: here it begins in the upper left."""

    def crop(x: Tensor, row: Tensor, col: Tensor, stride: int, radius: int) -> tuple[Tensor, Tensor, Tensor]:
        size = [min(2 * radius + 1, n) for n in x.shape[2:]]
        return x[:, :, : size[0], : size[1]].clone(), row, col

    for module in (fcn7, rpn):
        monkeypatch.setattr(module, "crop", crop)
    monkeypatch.setattr(BatchNorm, "forward", torch.nn.BatchNorm2d.forward)


def _batch(count: int) -> AttemptBatch:
    return AttemptBatch(
        color=torch.zeros(count, *SHAPE, 3, dtype=torch.uint8),
        height=torch.zeros(count, *SHAPE),
        **{name: torch.zeros(count, dtype=torch.int64) for name in ("angle", "row", "col", "replay_index")},
        label=torch.zeros(count),
        weight=torch.ones(count),
        augmentation=Augmentation(
            mirror=torch.zeros(count, 2, dtype=torch.bool),
            rotation=torch.zeros(count),
            shift=torch.zeros(count, 2),
            mixtures=random_mixtures(count, 0.0, torch.Generator()),
        ),
    )


@pytest.mark.parametrize("batchnorm", ["frozen", "batch"])
@pytest.mark.parametrize("angles", [1, 16])
@pytest.mark.parametrize("network", NETWORKS)
def test_deciding_and_learning_stay_on_the_device_of_the_network(network: str, angles: int, batchnorm: str) -> None:
    make: Callable[[], PixelNetwork] = NETWORKS[network]
    batch = _batch(2)
    module = make_module(make(), shape=SHAPE, angles=angles, batchnorm=batchnorm)
    module.log = lambda *args, **kwargs: None
    # It refuses an operation on tensors of two devices. Gradients need a real one, and are where what they are of is.
    with FakeTensorMode(allow_non_fake_inputs=True) as mode, torch.no_grad():
        for part in module.modules():
            for table in (part._parameters, part._buffers):
                for name, value in table.items():
                    if value is not None:
                        table[name] = FakeTensor(mode, value.to("meta"), CUDA)
        on_device = move_data_to_device(batch, torch.device("cuda"))
        maps = turned_logits(module.network, module.rotations, on_device.color[:1], on_device.height[:1])
        assert (maps.device.type, tuple(maps.shape)) == ("cuda", (angles, *SHAPE))
        outputs = module.training_step(on_device, 0)
        assert {value.device.type for value in outputs.values()} == {"cuda"}


def test_tensors_of_two_devices_are_refused_here() -> None:
    """So that the test above can fail."""
    with FakeTensorMode(), pytest.raises(RuntimeError, match="same device"):
        torch.zeros(2, device="cuda") + torch.zeros(2)
