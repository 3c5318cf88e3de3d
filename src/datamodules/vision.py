"""Data for pre-training: collected observations and their labels."""

from __future__ import annotations

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, TensorDataset

from see2act.datamodules.collect import Collection
from see2act.datamodules.labels import LabelSource, Task
from see2act.modules.vision import VisionBatch


class VisionDataModule(L.LightningDataModule):
    """Sensed heightmaps with label maps.

    Args:
        collection: Observations of random interaction.
        task: Makes the labels.
        label_source: ``truth`` for labels from the simulator, ``vision`` for labels from what a real robot could see.
        batch_size: Heightmaps per step.
        validation: Share of the observations that is kept out of training; these are the last ones.
        seed: Seed of the order of the training data.
    """

    def __init__(
        self,
        collection: Collection,
        task: Task,
        label_source: LabelSource,
        *,
        batch_size: int,
        validation: float,
        seed: int,
    ):
        super().__init__()
        self._batch_size = batch_size
        self._order = torch.Generator().manual_seed(seed)
        labels = np.stack([task.label(collection.view(i), label_source) for i in range(len(collection))])
        held_out = validation_count(len(collection), validation)
        self.positive_share = float(labels.mean())
        """Share of positive pixels over all observations."""
        tensors = [torch.from_numpy(a) for a in (collection.arrays["color"], collection.arrays["height"], labels)]
        self._train = TensorDataset(*[t[:-held_out] for t in tensors])
        # A copy, because two tensors that share memory cannot be passed to other processes (trainer=ddp).
        self._validation = TensorDataset(*[t[-held_out:].clone() for t in tensors])

    def train_dataloader(self) -> DataLoader:
        return DataLoader(
            self._train, self._batch_size, shuffle=True, drop_last=True, generator=self._order, collate_fn=_as_batch
        )

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self._validation, self._batch_size, collate_fn=_as_batch)


def validation_count(observations: int, share: float) -> int:
    """How many of some observations are kept out of training: the last ones."""
    return max(1, round(share * observations))


def channel_statistics(collection: Collection) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation over all observations, of R, G and B in 0..1 and height in metres.

    The standard deviation of a constant channel is set to 1.
    """
    mean, square = np.zeros(4), np.zeros(4)
    for color, height in zip(collection.arrays["color"], collection.arrays["height"], strict=True):  # one by one saves memory
        pixels = np.dstack([color / 255, height]).reshape(-1, 4)
        mean += pixels.mean(axis=0) / len(collection)
        square += (pixels**2).mean(axis=0) / len(collection)
    variance = square - mean**2
    std = np.sqrt(np.where(variance > 1e-12, variance, 1))  # rounding can make that of a constant channel negative
    return torch.tensor(mean, dtype=torch.float32), torch.tensor(std, dtype=torch.float32)


def _as_batch(samples: list[tuple[Tensor, ...]]) -> VisionBatch:
    return VisionBatch(*(torch.stack(tensors) for tensors in zip(*samples, strict=True)))
