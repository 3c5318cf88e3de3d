"""What a GPU is worth: deciding and learning of both networks on it and on the processor, and a short run of each to its end.

Ends at once where PyTorch finds no GPU.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import torch
from lightning.pytorch.utilities import move_data_to_device
from omegaconf import DictConfig

from benchmarks.common import PRIMITIVES, Work, timed
from benchmarks.stages import _backward, _batch, _heightmap, _module
from see2act.experiment.config import composed
from see2act.experiment.run import run
from see2act.modules.affordance import AffordanceModule, AttemptBatch

MODELS = ("fcn7", "rpn_r50_fpn")
SHORT = (
    *("task=none", "transfer=none", "logger=none", "finetune.attempts=6", "evaluate.at=[0]", "figures.scenes=1"),
    *("evaluate.attempts={seen: 2, unseen: 2}", "collect.interactions=12"),
)
"""A run that is over soon, from collecting to figures."""


def rows(overrides: list[str], repeats: int) -> Iterator[dict[str, Any]]:
    """A row for each network, primitive and piece of work."""
    if not torch.cuda.is_available():
        sys.exit("gpu-check: PyTorch finds no GPU here")
    print(f"gpu-check: {torch.cuda.get_device_name()}, torch {torch.__version__}", file=sys.stderr)
    for model in MODELS:
        for primitive in PRIMITIVES:
            cfg = composed([*overrides, f"primitive={primitive}", f"model={model}"])
            yield from _pieces(cfg, f"{model}, {primitive}", repeats)
    for model in MODELS:
        for trainer in ("gpu", "cpu"):
            yield _short_run([*overrides, *SHORT, f"model={model}", f"trainer={trainer}", "primitive=grasp"])


def _pieces(cfg: DictConfig, name: str, repeats: int) -> Iterator[dict[str, Any]]:
    here = _module(cfg)
    here.network.set_precision("fp32")
    there = _module(cfg).to("cuda")
    there.network.set_precision("fp32")
    heightmap, batch = _heightmap(cfg), _batch(cfg)
    on_gpu = move_data_to_device(batch, torch.device("cuda"))
    apart = abs(here.affordances(*heightmap) - there.affordances(*heightmap)).max()
    for precision in ("fp32", "bf16"):
        there.network.set_precision(precision)
        for piece, ours, plain in (
            ("decision", lambda: there.affordances(*heightmap), lambda: here.affordances(*heightmap)),
            ("learning step", lambda: _learn(there, on_gpu), lambda: _learn(here, batch)),
        ):
            seconds, naive = _median(ours, repeats), _median(plain, max(1, repeats // 3))
            row = {"name": f"{piece}, {name}, {precision} on the GPU", "seconds": seconds, "processor_fp32": naive}
            yield {**row, "ratio": naive / seconds, "logits_differ_in_fp32": float(apart)}


def _learn(module: AffordanceModule, batch: AttemptBatch) -> None:
    _backward(module, module.executed_logits(batch), batch)


def _median(work: Work, repeats: int) -> float:
    times = []
    for repeat in range(repeats + 1):
        torch.cuda.synchronize()
        start = perf_counter()
        work()
        torch.cuda.synchronize()
        if repeat:
            times.append(perf_counter() - start)
    return median(times)


def _short_run(overrides: list[str]) -> dict[str, Any]:
    cfg = composed(overrides)
    with TemporaryDirectory() as scratch:
        finetune = run(cfg, Path(scratch)).seconds["finetune"]
    row = {"name": f"fine-tuning, 6 grasps, {cfg.model.name}, trainer={cfg.trainer.accelerator}", "seconds": finetune}
    return row | dict.fromkeys(("processor_fp32", "ratio", "logits_differ_in_fp32"))


if __name__ == "__main__":
    timed(__doc__, "On a GPU and on the processor", rows)
