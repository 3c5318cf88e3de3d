"""How long learning takes as a whole: an attempt of the loop, an image of pre-training, and all runs of one seed of the
benchmark.

Vision models come from the cache, or are made now at the default numbers.
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.utilities.types import LRSchedulerConfigType
from omegaconf import DictConfig

from benchmarks.common import faster, limit, measured, overhead, timed
from see2act.datamodules.collect import Collection
from see2act.datamodules.replay import Replay
from see2act.datamodules.vision import VisionDataModule
from see2act.experiment import attempts, build
from see2act.experiment.config import composed
from see2act.experiment.context import RunContext
from see2act.experiment.quiet import quiet
from see2act.experiment.stages.collect import collected
from see2act.experiment.stages.finetune import learn
from see2act.experiment.stages.pretrain import vision_model
from see2act.experiment.stages.transfer import affordance_model
from see2act.modules.affordance import AffordanceModule
from see2act.modules.vision import VisionModule
from see2act.seeding import generator, seed_for

SOURCES = {"suction": "normal", "grasp": "foreground"}
"""A vision task that is best in the paper, for each primitive."""
SECONDS = {"suction": 0.38, "grasp": 0.6}
"""An attempt may take, learning included, on one core."""
STAGES = {
    "suction": {"filling the bin": 0.02, "observing": 0.035, "acting": 0.09, "learning": 0.2},
    "grasp": {"filling the bin": 0.02, "observing": 0.035, "deciding": 0.15, "acting": 0.2, "learning": 0.2},
}
"""The same of its stages; bins are filled with scenes that were dropped before."""
LARGE = ("model=rpn_r50_fpn", "task=none", "transfer=none")
"""The paper's network: what a vision model would have taught it makes it no faster."""
RUNS = 7
"""Of each primitive and seed: six sources transferred whole (none counts as one) and a backbone."""
REPEATED = 0.33
"""Share of the last evaluation's attempts that the plain argmax makes again: test runs with a failure (docs/results)."""
VISION_TASKS = 5
"""Learned before them, of the seed's own observations."""
HOURS = 0.5
EMPTY_BIN = 10 / 0.7
"""Attempts of a test run, if a bin of ten objects is emptied at a success rate of 0.7."""


def rows(overrides: list[str], repeats: int) -> Iterator[dict[str, Any]]:
    """The whole table, on one thread."""
    quiet()
    torch.set_num_threads(1)
    stages = {}
    with TemporaryDirectory() as scratch:
        for primitive, task in SOURCES.items():
            run, collection, module = _prepared(
                [*overrides, f"primitive={primitive}", f"task={task}", "transfer=full", f"finetune.attempts={10 * repeats}"],
                Path(scratch) / primitive,
            )
            more, stages[primitive] = looping(run, module, primitive)
            yield from more
        more, image = pretraining(run, collection, repeats)
        yield from more
        for primitive in SOURCES:
            few = f"finetune.attempts={max(2, repeats // 3)}"
            # What was typed of the model is of the small one.
            for_any = [override for override in overrides if not override.startswith("model")]
            run, _, module = _prepared([*for_any, *LARGE, f"primitive={primitive}", few], Path(scratch) / f"large-{primitive}")
            start = process_time()
            _fit(run, module)
            yield measured(f"attempt of the loop, {primitive}, rpn_r50_fpn", (process_time() - start) / run.attempts)
    runs = {primitive: composed(["experiment=vision_tasks", f"primitive={primitive}"]) for primitive in SOURCES}
    hours = sum(_grid(cfg, stages[name]) for name, cfg in runs.items())
    looked = sum(stages[primitive][name] for name in ("observing", "acting", "filling the bin"))
    hours += runs[primitive].collect.interactions * (looked + VISION_TASKS * runs[primitive].pretrain.epochs * image) / 3600
    yield limit(f"a seed of the benchmark, {2 * RUNS} runs, on two cores", hours / 2 * 3600, HOURS * 3600)


def _prepared(overrides: list[str], folder: Path) -> tuple[RunContext, Collection, AffordanceModule]:
    """A run up to its first attempt."""
    run = RunContext(composed([*overrides, "threads=1", "logger=none"]), folder)
    collection = collected(run.cfg)
    module, _ = affordance_model(run.cfg, collection, vision_model(run.cfg, collection, _trainers(run)))
    return run, collection, module


def _trainers(run: RunContext) -> Callable[..., L.Trainer]:
    return partial(build.trainer, run.cfg, run.folder, None)


def _fit(run: RunContext, module: AffordanceModule) -> None:
    run.log.begin()
    learn(run, module, _trainers(run), None, [])


def looping(run: RunContext, module: AffordanceModule, primitive: str) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """The first attempts of a run, through Lightning with log and checkpoints, against its stages one after the other.

    Returns:
        Rows, and the seconds of each stage an attempt.
    """
    plain = copy.deepcopy(module)
    stages: dict[str, float] = defaultdict(float)
    start = process_time()
    _fit(run, module)
    ours = (process_time() - start) / run.attempts
    for name, seconds in _stages(run.cfg, plain, run.folder / "attempts.csv"):
        stages[name] += seconds / run.attempts
    alone = sum(stages.values())
    return [
        overhead(f"attempt of the loop, {primitive}, against its stages alone", ours, alone, 1.1),
        limit(f"attempt of the loop, {primitive}", ours, SECONDS[primitive]),
        *(_stage(primitive, name, seconds) for name, seconds in stages.items()),
    ], stages


def _stage(primitive: str, name: str, seconds: float) -> dict[str, Any]:
    most = STAGES[primitive].get(name)
    return limit(f"  {name}", seconds, most) if most else measured(f"  {name}", seconds)


def _stages(cfg: DictConfig, module: AffordanceModule, log: Path) -> Iterator[tuple[str, float]]:
    """The attempts of ``log`` once more, without Lightning: what each stage takes.

    Raises:
        RuntimeError: The attempts differ.
    """
    robot, policy = build.robot_factory(cfg, cfg.primitive)(), build.policy(cfg)
    replay = Replay(**cfg.finetune.replay, pixel=cfg.workspace.pixel, rng=generator("replay", cfg.seed))
    explore, configured = generator("explore", cfg.seed), module.configure_optimizers()
    optimizer, rates = configured["optimizer"], cast(LRSchedulerConfigType, configured["lr_scheduler"])["scheduler"]
    module.train()
    seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def timing(name: str) -> Iterator[None]:
        start = process_time()
        yield
        seconds[name] += process_time() - start

    episode, tried = -1, cfg.finetune.episode_attempts
    for row in attempts.read(log):
        if tried == cfg.finetune.episode_attempts or robot.bin_empty():
            episode, tried = episode + 1, 0
            policy.forget()
            with timing("filling the bin"):
                robot.reset(seed_for("scene/finetune", cfg.seed, episode), "seen")
        with timing("observing"):
            heightmap = robot.observe().heightmap
        with timing("deciding"):
            logits = module.affordances(heightmap.color, heightmap.height)
            choice = policy.choose(logits, heightmap, cfg.finetune.temperature, explore)
        pick = robot.workspace.pick(heightmap, choice.row, choice.col, choice.angle * torch.pi / len(logits))
        with timing("acting"):
            outcome = robot.execute(pick)
        if (choice.row, choice.col, outcome.success) != (row.row, row.col, row.success):
            raise RuntimeError("the loop attempts something else than its stages one after the other")
        policy.remember(choice, heightmap, outcome.success)
        tried += 1
        with timing("learning"):
            replay.add(heightmap.color, heightmap.height, choice.angle, choice.row, choice.col, outcome.success)
            for _ in range(cfg.finetune.updates):
                optimizer.zero_grad()
                batch = replay.sample(cfg.finetune.batch_size)
                outputs = module.training_step(batch, 0)
                outputs["loss"].backward()
                optimizer.step()
                rates.step()
                module.on_train_batch_end()
                replay.update(batch.replay_index.numpy(), outputs["td_error"].numpy())
    robot.close()
    yield from seconds.items()


def pretraining(run: RunContext, collection: Collection, repeats: int) -> tuple[list[dict[str, Any]], float]:
    """An image of an epoch, loading and augmentation and all, against the network's forward and backward alone.

    Returns:
        Rows, and the seconds of an image.
    """
    cfg = run.cfg
    data = VisionDataModule(
        collection, build.task(cfg), cfg.labels, batch_size=cfg.pretrain.batch_size, validation=cfg.pretrain.validation, seed=0
    )
    steps = len(data.train_dataloader())
    module = VisionModule(
        build.network(cfg, 0), lr=cfg.pretrain.lr, weight_decay=cfg.pretrain.weight_decay, pos_weight=1.0, seed=0
    )
    batch = next(iter(data.train_dataloader()))
    x, label = module.network.prepare(batch.color, batch.height), batch.label[:, None].float()
    ours, bare = [], []
    for _ in range(max(1, repeats // 3)):
        trainer = _trainers(run)(max_epochs=1, limit_val_batches=0, enable_progress_bar=False)
        start = process_time()
        trainer.fit(module, datamodule=data)
        ours.append((process_time() - start) / steps)
        start = process_time()
        for _ in range(steps):
            module.loss(module.network(x), label).backward()
        bare.append((process_time() - start) / steps)
    seconds, naive = median(ours) / len(x), median(bare) / len(x)
    return [faster("pre-training, an image, against forward and backward alone", seconds, naive, 0.8)], seconds


def _grid(cfg: DictConfig, stages: dict[str, float]) -> float:
    """Hours of one core for all runs of a primitive and seed."""
    tests = len({0, *cfg.evaluate.at, cfg.finetune.attempts})
    attempted = (tests + REPEATED) * cfg.evaluate.runs * sum(min(EMPTY_BIN, n) for n in cfg.evaluate.attempts.values())
    tested = sum(stages[name] for name in ("observing", "deciding", "acting", "filling the bin"))
    return RUNS * (cfg.finetune.attempts * sum(stages.values()) + attempted * tested) / 3600


if __name__ == "__main__":
    timed(__doc__, "Learning as a whole", rows)
