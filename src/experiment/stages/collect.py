"""Stage 1: observations of random interaction, from the cache or made now."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from see2act.datamodules.collect import Collection, collect
from see2act.experiment.build import robot_factory
from see2act.experiment.cache import once
from see2act.experiment.identity import code_hash, deciding_robot, hash_of, packages, plain
from see2act.seeding import seed_for

log = logging.getLogger("see2act")


def collected(cfg: DictConfig) -> Collection:
    """The observations that vision models learn from."""
    return _collection(cfg, cfg.collect.interactions, cfg.collect.per_scene, cfg.collect.seed)


def held_out(cfg: DictConfig) -> Collection:
    """Observations of other scenes, one each, by which vision models are judged."""
    return _collection(cfg, cfg.pretrain.test_scenes, 1, seed_for("held out", cfg.collect.seed))


def collection_key(cfg: DictConfig) -> str:
    """Hash of everything that decides what :func:`collected` gives."""
    return _key(cfg, cfg.collect.interactions, cfg.collect.per_scene, cfg.collect.seed)


def _collection(cfg: DictConfig, interactions: int, per_scene: int, seed: int) -> Collection:
    path = Path(cfg.paths.cache).absolute() / "collections" / f"{_key(cfg, interactions, per_scene, seed)}.npz"

    def make() -> None:
        make_robot = robot_factory(cfg, cfg.collect.primitive)
        most_objects = cfg.objects.kinds * cfg.objects.copies
        collect(make_robot, interactions, per_scene, most_objects, seed, cfg.collect.workers).save(path)

    made = once(path, make)
    log.info("collect: %d observations %s %s", interactions, "written to" if made else "from", path)
    return Collection.load(path)


def _key(cfg: DictConfig, interactions: int, per_scene: int, seed: int) -> str:
    keys = {**plain(cfg, "workspace", "camera", "objects"), "robot": deciding_robot(cfg)}
    keys["collect"] = {"interactions": interactions, "per_scene": per_scene, "seed": seed}
    keys["collect"]["primitive"] = plain(cfg.collect.primitive, "end_effector")
    keys["code"] = code_hash("robot", "datamodules/collect.py", "seeding.py")
    keys["versions"] = packages()
    return hash_of(keys)
