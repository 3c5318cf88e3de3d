"""Stage 1: observations of random interaction, from the cache or made now; of an attended robot from a folder that is kept."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from see2act.datamodules.collect import Collection, collect
from see2act.datamodules.vision import validation_count
from see2act.experiment import build
from see2act.experiment.attended import attended
from see2act.experiment.cache import once
from see2act.experiment.folder import alone_in
from see2act.experiment.identity import code_hash, deciding_robot, hash_of, packages, plain
from see2act.seeding import seed_for

log = logging.getLogger("see2act")


def collected(cfg: DictConfig) -> Collection:
    """The observations that vision models learn from."""
    if attended(cfg):
        return _attended(cfg)
    return _collection(cfg, cfg.collect.interactions, cfg.collect.per_scene, cfg.collect.seed)


def held_out(cfg: DictConfig) -> Collection:
    """Observations of other scenes, one each, by which vision models are judged.

    Of an attended robot they are those that were kept out of training: nobody fills the bin a hundred times for one number.
    """
    if attended(cfg):
        collection = build.observations(cfg).first(cfg.collect.interactions)
        return collection.last(validation_count(len(collection), cfg.pretrain.validation))
    return _collection(cfg, cfg.pretrain.test_scenes, 1, seed_for("held out", cfg.collect.seed))


def collection_key(cfg: DictConfig) -> str:
    """Hash of everything that decides what :func:`collected` gives, or of an attended robot, of what it has given."""
    if attended(cfg):
        return build.observations(cfg).digest(cfg.collect.interactions)
    return _key(cfg, cfg.collect.interactions, cfg.collect.per_scene, cfg.collect.seed)


def scenes_left(cfg: DictConfig) -> int:
    """How often a person has to fill the bin before :func:`collected` has what it gives."""
    return build.observations(cfg).scenes_left(cfg.collect.interactions, cfg.collect.per_scene)


def _attended(cfg: DictConfig) -> Collection:
    observations, count = build.observations(cfg), cfg.collect.interactions
    if len(observations) < count:
        observations.folder.mkdir(parents=True, exist_ok=True)
        robot = build.robot_factory(cfg, cfg.primitive)()  # it has one tool
        try:
            with alone_in(observations.folder):
                observations.add(
                    robot,
                    count,
                    cfg.collect.per_scene,
                    cfg.objects.kinds * cfg.objects.copies,
                    cfg.collect.seed,
                    build.policy(cfg).plain(),
                    cfg.primitive.angles,
                )
        finally:
            robot.close()
    log.info("collect: the first %d of %d observations in %s", count, len(observations), observations.folder)
    return observations.first(count)


def _collection(cfg: DictConfig, interactions: int, per_scene: int, seed: int) -> Collection:
    path = Path(cfg.paths.cache).absolute() / "collections" / f"{_key(cfg, interactions, per_scene, seed)}.npz"

    def make() -> None:
        make_robot = build.robot_factory(cfg, cfg.collect.primitive)
        most_objects = cfg.objects.kinds * cfg.objects.copies
        collect(make_robot, interactions, per_scene, most_objects, seed, cfg.collect.workers).save(path)

    collection, made = once(path, make, Collection.load)
    log.info("collect: %d observations %s %s", interactions, "written to" if made else "from", path)
    return collection


def _key(cfg: DictConfig, interactions: int, per_scene: int, seed: int) -> str:
    keys = {**plain(cfg, "workspace", "camera", "objects"), "robot": deciding_robot(cfg)}
    keys["collect"] = {"interactions": interactions, "per_scene": per_scene, "seed": seed}
    keys["collect"]["primitive"] = plain(cfg.collect.primitive, "end_effector")
    keys["code"] = code_hash("robot", "datamodules/collect.py", "seeding.py")
    keys["versions"] = packages()
    return hash_of(keys)
