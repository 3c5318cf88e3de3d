"""Stage 2: the vision model, given, from the cache, or trained now; or the affordance model of another run."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from see2act.datamodules.collect import Collection
from see2act.datamodules.vision import VisionDataModule, channel_statistics
from see2act.errors import ConfigError, TransferError
from see2act.experiment import build, model_file
from see2act.experiment.attended import attended
from see2act.experiment.cache import once
from see2act.experiment.checkpoints import load_checkpoint, save_checkpoint
from see2act.experiment.identity import code_hash, deciding_trainer, hash_of, plain, weights_file
from see2act.experiment.stages.collect import collection_key, held_out
from see2act.modules import weights
from see2act.modules.average_precision import average_precision
from see2act.modules.vision import VisionModule
from see2act.seeding import seed_for

log = logging.getLogger("see2act")
QUALITY = ("positive_share", "val_loss", "average_precision")
"""Keys of a vision checkpoint that say how good the model is."""
VisionCheckpoint = dict[str, Any]
"""``task`` (its name), ``network`` (state dict), and of a model that was trained here ``QUALITY``."""


def vision_model(
    cfg: DictConfig, collection: Collection | None, make_trainer: Callable[..., L.Trainer]
) -> VisionCheckpoint | None:
    """The checkpoint of the source: a vision model, or an affordance model of another run; None for ``task=none``.

    Args:
        cfg: Of the run.
        collection: What a vision model learns from; None where nothing was collected.
        make_trainer: Builds a trainer from what the configuration of the trainer leaves open.
    """
    if cfg.task.weights or cfg.task.off_the_shelf:
        statistics = channel_statistics(collection) if collection else (None, None)
        return {"task": cfg.task.name, "network": given_weights(cfg, *statistics)}
    if cfg.task.label is None:
        return None
    assert collection is not None
    path = vision_path(cfg)
    checkpoint, made = once(
        path,
        lambda: _train(cfg, collection, make_trainer, path),
        lambda path: load_checkpoint(path, ("task", "network", *QUALITY)),
    )
    log.info("pretrain: %s %s %s", cfg.task.name, "trained, kept at" if made else "from", path)
    log.info("pretrain: average precision %.2f on held-out scenes", checkpoint["average_precision"])
    return checkpoint


def vision_path(cfg: DictConfig) -> Path:
    """Where the cache has the vision model. Nothing that a primitive or fine-tuning decides is part of its key."""
    keys: dict[str, Any] = {"collection": collection_key(cfg)}
    keys |= {**plain(cfg, "task", "pretrain"), **plain(cfg.model, "network"), "labels": cfg.labels}
    keys |= {"trainer": deciding_trainer(cfg), "precision": cfg.precision}
    places = ("modules", "datamodules/labels.py", "datamodules/vision.py", "experiment/stages/pretrain.py", "seeding.py")
    keys["code"] = code_hash(*places)
    return Path(cfg.paths.cache).absolute() / "vision" / f"{cfg.task.name}-{cfg.model.name}-{hash_of(keys)}.ckpt"


def given_weights(cfg: DictConfig, mean: Tensor | None, std: Tensor | None) -> dict[str, Tensor]:
    """State dict of a model from elsewhere.

    Off-the-shelf weights lack statistics of the height; those are taken from our data (``mean``, ``std``: (4,)).

    Raises:
        TransferError: It cannot be read, is of another task, or is no vision model.
        ModelFileError: Of ``task=affordance``: it is no affordance model, or one that does not fit.
    """
    task = cfg.task
    if task.affordance:
        return model_file.load_fitting(weights_file(task.weights), cfg).network.state_dict()
    if task.weights and model_file.is_model(Path(task.weights)):
        raise TransferError(
            f"{task.weights} is a fine-tuned model: give the same run's checkpoints/vision.ckpt, or type task=affordance"
        )
    if task.weights and (known := weights.task_of(Path(task.weights))) not in (None, task.name):
        raise TransferError(f"{task.weights} learned {known}, not {task.name}: type task={known}, or give another file")
    if not task.off_the_shelf:
        return weights.read(Path(task.weights))
    source: weights.OffTheShelf = instantiate(task.off_the_shelf[cfg.model.name])
    state = source.read(task.weights, Path(cfg.paths.cache).absolute())
    for name, ours in (("normalization.mean", mean), ("normalization.std", std)):
        assert ours is not None
        state[name] = torch.cat([state[name][:3], state[name][3:] if len(state[name]) == 4 else ours[3:]])
    return state


def _train(cfg: DictConfig, collection: Collection, make_trainer: Callable[..., L.Trainer], path: Path) -> None:
    seed, task = cfg.pretrain.seed, build.task(cfg)
    data = VisionDataModule(
        collection,
        task,
        cfg.labels,
        batch_size=cfg.pretrain.batch_size,
        validation=cfg.pretrain.validation,
        seed=seed_for("batches", seed),
    )
    share = data.positive_share
    log.info("pretrain: %s labels %.1f %% of the pixels as positive", cfg.task.name, 100 * share)
    if not 0 < share < 1:
        raise ConfigError(
            f"task={cfg.task.name} labels all pixels alike: check its parameters in conf/task/{cfg.task.name}.yaml"
        )
    scenes = held_out(cfg)
    labels = held_out_labels(cfg, scenes)  # before it learns, since without any it cannot be judged
    network = build.network(cfg, seed_for("vision", seed))
    network.normalization.set(*channel_statistics(collection))
    module = VisionModule(
        network,
        lr=cfg.pretrain.lr,
        weight_decay=cfg.pretrain.weight_decay,
        pos_weight=(1 - share) / share if cfg.task.class_weight == "balanced" else 1.0,
        seed=seed_for("augment", seed),
    )
    trainer = make_trainer(max_epochs=cfg.pretrain.epochs)
    build.fit(trainer, module, data)
    val_loss = float(trainer.callback_metrics["vision/val_loss"])
    if not math.isfinite(val_loss):
        raise ConfigError(f"the vision model has diverged (loss {val_loss}): lower pretrain.lr={cfg.pretrain.lr}")
    module.to(build.device(cfg))
    scores = network.scores(scenes.arrays["color"], scenes.arrays["height"])
    checkpoint: VisionCheckpoint = {
        "task": cfg.task.name,
        "network": {name: value.cpu() for name, value in network.state_dict().items()},
        "positive_share": share,
        "val_loss": val_loss,
        "average_precision": average_precision(scores, labels, task.tolerance),
    }
    save_checkpoint(path, checkpoint)


def held_out_labels(cfg: DictConfig, scenes: Collection) -> np.ndarray:
    """Label maps of the scenes by which a vision model will be judged, (n, H, W).

    Raises:
        ConfigError: No pixel is labelled.
    """
    task = build.task(cfg)
    labels = np.stack([task.label(scenes.view(i), cfg.labels) for i in range(len(scenes))])
    if not labels.any():
        more = "collect.interactions" if attended(cfg) else "pretrain.test_scenes"
        raise ConfigError(
            f"task={cfg.task.name} labels nothing in {len(scenes)} held-out scenes: raise {more}, or check its parameters in "
            f"conf/task/{cfg.task.name}.yaml"
        )
    return labels
