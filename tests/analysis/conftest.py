"""Folders that look like runs, with numbers one can follow by hand."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf
from see2act.experiment.attempts_csv import COLUMNS
from see2act.experiment.results import BLOCK

Counts = Sequence[tuple[int, int]]
"""Successes and attempts of each test run."""
VERSIONS = {"python": "3.11.7", "see2act": "0.1.0", "numpy": "2.4.6"}


def _part(counts: Counts) -> dict[str, Any]:
    successes, attempts = (sum(column) for column in zip(*counts, strict=True))
    runs = [{"scene_seed": i, "successes": s, "attempts": n, "lost": 0} for i, (s, n) in enumerate(counts)]
    return {
        **{"successes": successes, "attempts": attempts, "rate": successes / attempts},
        **{"truth_successes": successes, "runs": runs},
    }


def _point(seen: Counts, unseen: Counts) -> dict[str, Any]:
    return {"seen": _part(seen), "unseen": _part(unseen)}


def _curve(learned: Sequence[int]) -> list[dict[str, int]]:
    blocks = [learned[i : i + BLOCK] for i in range(0, len(learned), BLOCK)]
    steps = [min((i + 1) * BLOCK, len(learned)) for i in range(len(blocks))]
    return [{"step": step, "successes": sum(b), "attempts": len(b)} for step, b in zip(steps, blocks, strict=True)]


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes a run below ``tmp_path / "runs"``; the folder of the run."""

    def make(
        cell: str = "normal-full",
        primitive: str = "suction",
        seed: int = 0,
        config_hash: str = "aaaaaaaaaaaa",
        seen: Counts = ((8, 10), (9, 10)),
        unseen: Counts = ((7, 10), (10, 10)),
        zero: Counts = ((3, 10), (4, 10)),
        learned: Sequence[int] = (0, 1) * 20,
        finished: bool = True,
        name: str | None = None,
        versions: dict[str, str] = VERSIONS,
        pictures: bool = False,
        **config: Any,
    ) -> Path:
        task, transfer = cell.split("-")
        folder = tmp_path / "runs" / primitive / "fcn7" / cell / config_hash / (name or f"seed{seed}")
        (folder / ".hydra").mkdir(parents=True)
        words = {"task": task, "transfer": transfer, "primitive": primitive, "model": config.pop("model", "fcn7")}
        words |= {"objects": "diverse", "workspace": "bin", "camera": "side", "policy": "suppress"}
        full = OmegaConf.create({key: {"name": word} for key, word in words.items()})
        full.merge_with(
            {
                **{"seed": seed, "threads": 1, "primitive": {"attempts": len(learned)}},
                **{"evaluate": {"runs": len(seen), "attempts": {"seen": 25, "unseen": 15}, "scenes": "evaluate"}},
                **{"finetune": {"attempts": "${primitive.attempts}", "logit_scale": 0.25}},
            }
        )
        overrides = [f"task={task}", f"transfer={transfer}", f"primitive={primitive}", "threads=1"]
        for key, value in config.items():
            OmegaConf.update(full, key.replace("__", "."), value)
            overrides.append(f"{key.replace('__', '.')}={value}")
        OmegaConf.save(full, folder / ".hydra" / "config.yaml")
        OmegaConf.save(OmegaConf.create([*overrides, f"seed={seed}"]), folder / ".hydra" / "overrides.yaml")
        (folder / "run.json").write_text(json.dumps({"config_hash": config_hash, "seed": seed}))
        before, after = _point(zero, zero), _point(seen, unseen)
        if not learned:
            before = after = {**before, "repeated": True}
        steps = {0: before, len(learned): after}
        _write_attempts(folder / "attempts.csv", primitive, steps, learned)
        if pictures:
            (folder / "figures").mkdir()
            for picture in ("heatmaps", "picks"):
                cv2.imwrite(str(folder / "figures" / f"{picture}.png"), np.full((300, 1600, 3), 90, np.uint8))
        result = {
            "choices": {**words, "labels": "truth", "seed": seed, "precision": "fp32", "motion": "fast"},
            **{"config_hash": config_hash, "versions": versions, "seconds": {"finetune": 90.0, "figures": 30.0}},
            **{"zero_shot": before, "eval": after, "eval_argmax": _point(zero, zero)},
            **{"evals": [{"step": step, **point} for step, point in steps.items()], "curve": _curve(learned)},
        }
        if finished:
            (folder / "result.json").write_text(json.dumps(result))
        return folder

    return make


def _write_attempts(path: Path, primitive: str, steps: dict[int, dict[str, Any]], learned: Sequence[int]) -> None:
    """Each attempt takes the robot six seconds; what fails missed, or slipped while learning."""
    rows: list[dict[str, Any]] = []
    common = {"policy": "suppress", "primitive": primitive, "robot_seconds": "6.000"}
    for step, point in steps.items():
        for split in ("seen", "unseen"):
            for success in [1] * point[split]["successes"] + [0] * (point[split]["attempts"] - point[split]["successes"]):
                where = {"phase": "eval" if step else "zero_shot", "split": split, "step": step, "success": success}
                rows.append({**common, **where, "cause": "ok" if success else "missed"})
    for step, success in enumerate(learned, 1):
        where = {"phase": "finetune", "split": "seen", "step": step, "success": success}
        rows.append({**common, **where, "cause": "ok" if success else "slipped"})
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="0")
        writer.writeheader()
        writer.writerows(rows)
