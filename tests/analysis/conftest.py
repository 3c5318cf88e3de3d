"""Folders that look like runs, with numbers one can follow by hand."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from see2act.experiment.attempts import AttemptsCsv
from see2act.experiment.results import SPLITS, RunResult
from tests.factory import VERSIONS, Counts, attempt_row, finished_run


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
        between: Mapping[int, Counts] | None = None,
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
        result = finished_run(seed, config_hash, seen, unseen, zero, learned, versions, between, **words)
        _write_attempts(folder / "attempts.csv", result, learned)
        if pictures:
            (folder / "figures").mkdir()
            for picture in ("heatmaps", "picks"):
                cv2.imwrite(str(folder / "figures" / f"{picture}.png"), np.full((300, 1600, 3), 90, np.uint8))
        if finished:
            (folder / "result.json").write_text(json.dumps(result.model_dump(mode="json")))
        return folder

    return make


def _write_attempts(path: Path, result: RunResult, learned: Sequence[int]) -> None:
    """Each attempt takes the robot six seconds; what fails missed, or slipped while learning."""
    log, primitive = AttemptsCsv(path), result.choices["primitive"]
    log.begin()
    for point in result.evals:
        for split in SPLITS:
            for i in range(point[split].attempts):
                success = i < point[split].successes
                log.append(
                    attempt_row(
                        phase="eval" if point.step else "zero_shot",
                        split=split,
                        step=point.step,
                        success=success,
                        cause="ok" if success else "missed",
                        primitive=primitive,
                    )
                )
    for step, success in enumerate(learned, 1):
        log.append(attempt_row(step=step, success=bool(success), cause="ok" if success else "slipped", primitive=primitive))
