"""How long the parts of an attempt take, each beside the plain way to do the same, measured in turns in one process."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from statistics import median
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from benchmarks.common import PRIMITIVES, Work, faster, limit, not_here, overhead, race, timed
from see2act.datamodules.replay import Replay
from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.experiment.evaluation import scene_seed
from see2act.experiment.precision import computes_bf16
from see2act.modules.affordance import AffordanceModule, AttemptBatch
from see2act.modules.batchnorm import batchnorms
from see2act.modules.network import PRECISIONS, PixelNetwork
from see2act.robot.simulated import SimulatedRobot
from see2act.seeding import generator

GRADIENT = 1e-4
"""By which gradients of the part and of the whole heightmap may differ, as a share of the largest, in one layout.

Another layout sums in another order, and a ReLU that flips by that changes a gradient of 50 layers in single precision by a
hundredth, though in double precision the two agree to 1e-14. So layouts are left to the tests of logits.
"""


def observing(overrides: list[str], repeats: int) -> list[dict[str, Any]]:
    """Rendering, noise, point cloud and heightmap, against the whole of the camera's picture alone."""
    robot = _robot(composed(overrides))
    robot.reset(scene_seed("seen", 0), "seen")
    whole = replace(robot.camera, crop=None)
    ours, plain = race(robot.observe, lambda: whole.render(robot.simulation), repeats)
    robot.close()
    return [
        overhead("observation, against getCameraImage", ours, plain, 1.3),
        limit("observation", ours, 0.035),
    ]


def filling(overrides: list[str], repeats: int) -> list[dict[str, Any]]:
    """A scene put back from its layout, against the same scene dropped."""
    cfg = composed(overrides)
    with TemporaryDirectory() as scratch:
        robots = [_robot(composed([*overrides, f"robot.layouts={layouts}"])) for layouts in (scratch, "null")]
        scenes = [scene_seed("seen", run) for run in range(max(2, repeats // 2))]

        def fill(robot: SimulatedRobot) -> None:
            for seed in scenes:
                robot.reset(seed, "seen")

        seconds, dropped = race(lambda: fill(robots[0]), lambda: fill(robots[1]), 1)
        for robot in robots:
            robot.close()
    name = f"a bin filled from its layout, against dropped ({cfg.objects.kinds * cfg.objects.copies} objects)"
    return [faster(name, seconds / len(scenes), dropped / len(scenes), None)]


def attempting(overrides: list[str], primitive: str, picks: int) -> list[dict[str, Any]]:
    """Random picks on objects, against as many bare steps of the same scene with nothing asleep.

    Some of our steps, those of a lift, solve contacts more exactly than the bare ones.
    """
    cfg = composed([*overrides, f"primitive={primitive}"])
    robot, rng = _robot(cfg), generator("benchmarks/stages")
    ours, inside, plain = [], [], []
    for run in range(picks):
        seed = scene_seed("seen", run)
        robot.reset(seed, "seen")
        heightmap = robot.observe().heightmap
        row, col = rng.choice(np.argwhere(robot.truth().body >= 0))
        pick = robot.workspace.pick(heightmap, int(row), int(col), float(rng.integers(16) * np.pi / 16))
        step, stepping = robot.simulation.client.stepSimulation, [0.0]

        def timed_step(step: Work = step, stepping: list[float] = stepping) -> None:
            start = process_time()
            step()
            stepping[0] += process_time() - start

        robot.simulation.client.stepSimulation = timed_step
        start = process_time()
        steps = robot.execute(pick).steps
        assert steps, "the benchmark's picks are within reach"
        ours.append(process_time() - start)
        inside.append(stepping[0])
        robot.simulation.client.stepSimulation = step
        robot.reset(seed, "seen")
        robot.scene.wake()
        start = process_time()
        for _ in range(steps):
            step()
        plain.append(process_time() - start)
    robot.close()
    return [
        overhead(f"attempt, {primitive}, against its steps bare and awake", median(ours), median(plain), 1.3),
        overhead(f"attempt, {primitive}, against its own time in stepSimulation", median(ours), median(inside), None),
    ]


def deciding(overrides: list[str], model: str, repeats: int) -> list[dict[str, Any]]:
    """Sixteen rotations: in batches and in the fast layout, against one after the other as a network comes."""
    cfg = composed([*overrides, "primitive=grasp", f"model={model}"])
    plain, color, height = _module(cfg), *_heightmap(cfg)

    def one_by_one() -> np.ndarray:
        rotations, maps = plain.rotations, []
        with torch.no_grad():
            x = plain.network.prepare(torch.from_numpy(color)[None], torch.from_numpy(height)[None])
            for i, canvas in enumerate(rotations.canvases):
                angle = torch.tensor([i])
                maps.append(rotations.back(plain.network(rotations.turned(x, angle, canvas)), angle))
            back: np.ndarray = torch.cat(maps).numpy()
        return back

    rows = []
    targets = {("fcn7", "fp32"): 1.2, ("fcn7", "bf16"): 3.0, ("rpn_r50_fpn", "bf16"): 2.0}
    for precision in PRECISIONS:
        name = f"decision, 16 rotations, {model}, {precision}"
        if precision == "bf16" and not computes_bf16():
            rows.append(not_here(name))
            continue
        ours = _fast(plain, precision)
        if precision == "fp32" and ours.affordances(color, height).argmax() != one_by_one().argmax():
            raise RuntimeError("the fast decision picks another pixel than the plain one")
        seconds = race(lambda ours=ours: ours.affordances(color, height), one_by_one, repeats)  # type: ignore[misc]
        rows.append(faster(name, *seconds, targets.get((model, precision))))
    return rows


def learning(overrides: list[str], model: str, primitive: str, repeats: int) -> list[dict[str, Any]]:
    """A learning step on what the executed pixels depend on, against one on whole turned heightmaps in fp32."""
    cfg = composed([*overrides, f"primitive={primitive}", f"model={model}"])
    plain, batch = _module(cfg), _batch(cfg)

    def whole() -> None:
        x, angles = plain.network.prepare(batch.color, batch.height), batch.angle
        rows, cols = plain.rotations.locate(angles, batch.row, batch.col)
        canvases = [plain.rotations.canvases[angle] for angle in angles.tolist()]
        logits = torch.empty(len(x))
        for canvas in dict.fromkeys(canvases):
            some = torch.tensor([i for i, other in enumerate(canvases) if other == canvas])
            maps = plain.network(plain.rotations.turned(x[some], angles[some], canvas))
            logits[some] = maps[torch.arange(len(some)), 0, rows[some], cols[some]]
        _backward(plain, logits, batch)

    whole()
    part = copy.deepcopy(plain)
    _backward(part, part.executed_logits(batch), batch)
    _same_gradient(part, plain)
    rows = []
    targets = {("fcn7", "suction", "fp32"): 2.0, ("fcn7", "grasp", "fp32"): 3.0, ("rpn_r50_fpn", "grasp", "bf16"): 2.0}
    for precision in PRECISIONS:
        name = f"learning step, {model}, {primitive}, {precision}"
        if precision == "bf16" and not computes_bf16():
            rows.append(not_here(name))
            continue
        ours = _fast(plain, precision)
        seconds = race(
            lambda ours=ours: _backward(ours, ours.executed_logits(batch), batch),  # type: ignore[misc]
            whole,
            repeats,
        )
        rows.append(faster(name, *seconds, targets.get((model, primitive, precision))))
    return rows


def remembering(overrides: list[str], repeats: int) -> list[dict[str, Any]]:
    """A draw and its update among 100 000 transitions, against 1 000."""
    cfg = composed(overrides)
    rng = generator("benchmarks/stages/heightmaps")
    patch = np.ones((16, 16), np.uint8)  # plain surfaces, which compress as those of a bin do
    several = [
        (
            np.kron(rng.integers(0, 256, (9, 9, 3), dtype=np.uint8), patch[:, :, None]),
            np.kron(rng.random((9, 9), np.float32), patch),
        )
        for _ in range(200)
    ]

    def draws(size: int) -> Work:
        replay = Replay(**cfg.finetune.replay, pixel=cfg.workspace.pixel, rng=generator("benchmarks/stages/replay"))
        for i in range(size):
            replay.add(*several[i % len(several)], 0, 72, 72, i % 3 == 0)

        def draw() -> None:
            batch = replay.sample(cfg.finetune.batch_size)
            replay.update(batch.replay_index.numpy(), np.linspace(0, 1, cfg.finetune.batch_size))

        return draw

    return [overhead("replay at 100 000 transitions, against 1 000", *race(draws(100_000), draws(1_000), 20 * repeats), 1.5)]


def _robot(cfg: DictConfig) -> SimulatedRobot:
    return build.robot_factory(cfg, cfg.primitive)()


def _module(cfg: DictConfig) -> AffordanceModule:
    """With statistics that let signals through, as after training."""
    torch.manual_seed(0)
    network: PixelNetwork = instantiate(cfg.model.network)
    for layer in batchnorms(network).values():
        assert layer.running_mean is not None
        assert layer.running_var is not None
        layer.running_mean.normal_(0, 0.1)
        layer.running_var.uniform_(0.5, 2)
    network.normalization.set(torch.full((4,), 0.3), torch.full((4,), 0.3))
    workspace = instantiate(cfg.workspace)
    return AffordanceModule(
        network,
        shape=workspace.shape,
        angles=cfg.primitive.angles,
        backbone_lr=1e-4,
        head_lr=1e-4,
        lr_warmup=0,
        weight_decay=0.0,
        batchnorm="frozen",
        averaging=0.0,
        averaging_warmup=0,
    )


def _fast(module: AffordanceModule, precision: str) -> AffordanceModule:
    fast = copy.deepcopy(module)
    fast.network.set_precision(precision)
    return fast


def _heightmap(cfg: DictConfig) -> tuple[np.ndarray, np.ndarray]:
    rng, shape = generator("benchmarks/stages/heightmap"), instantiate(cfg.workspace).shape
    return rng.integers(0, 256, (*shape, 3), dtype=np.uint8), rng.random(shape, np.float32) * 0.1


def _batch(cfg: DictConfig) -> AttemptBatch:
    color, height = _heightmap(cfg)
    rng, n = generator("benchmarks/stages/batch"), cfg.finetune.batch_size
    return AttemptBatch(
        color=torch.from_numpy(np.stack([color] * n)),
        height=torch.from_numpy(np.stack([height] * n)),
        angle=torch.from_numpy(rng.integers(cfg.primitive.angles, size=n)),
        row=torch.from_numpy(rng.integers(height.shape[0], size=n)),
        col=torch.from_numpy(rng.integers(height.shape[1], size=n)),
        label=torch.from_numpy(rng.integers(2, size=n)).float(),
        weight=torch.ones(n),
        replay_index=torch.arange(n),
    )


def _backward(module: AffordanceModule, logits: Tensor, batch: AttemptBatch) -> None:
    module.zero_grad()
    F.binary_cross_entropy_with_logits(logits, batch.label).backward()


def _same_gradient(part: AffordanceModule, plain: AffordanceModule) -> None:
    for (name, a), b in zip(part.named_parameters(), plain.parameters(), strict=True):
        if (a.grad is None) != (b.grad is None):
            raise RuntimeError(f"only one of the learning steps has a gradient in {name}")
        if a.grad is not None and b.grad is not None and (a.grad - b.grad).abs().max() > GRADIENT * b.grad.abs().max():
            raise RuntimeError(f"the learning step on a part has another gradient than that on the whole, in {name}")


def rows(overrides: list[str], repeats: int) -> Iterator[dict[str, Any]]:
    """The whole table, on one thread."""
    torch.set_num_threads(1)
    yield from observing(overrides, repeats)
    yield from filling(overrides, repeats)
    for primitive in PRIMITIVES:
        yield from attempting(overrides, primitive, 3 * repeats)
    yield from deciding(overrides, "fcn7", repeats)
    for primitive in PRIMITIVES:
        yield from learning(overrides, "fcn7", primitive, repeats)
    few = max(1, repeats // 3)
    yield from deciding(overrides, "rpn_r50_fpn", few)
    yield from learning(overrides, "rpn_r50_fpn", "grasp", few)
    yield from remembering(overrides, repeats)


if __name__ == "__main__":
    timed(__doc__, "Stages of an attempt", rows)
