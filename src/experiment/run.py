"""One run: its stages in order. What is finished is not repeated when an interrupted run continues."""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
from omegaconf import DictConfig

from see2act.attempt import Attempt
from see2act.datamodules.collect import Collection
from see2act.datamodules.records import testing
from see2act.errors import TransferError
from see2act.experiment import attempts, build, charts, figures, model_file
from see2act.experiment.attended import attended
from see2act.experiment.checkpoints import save_checkpoint
from see2act.experiment.context import RunContext
from see2act.experiment.dashboard import Dashboard
from see2act.experiment.folder import earlier_versions
from see2act.experiment.identity import CHOICES, commit, config_hash, versions
from see2act.experiment.refills import refills
from see2act.experiment.results import RunResult, StepEvaluation, VisionQuality, curve, write_result
from see2act.experiment.stages.collect import collected, held_out, scenes_left
from see2act.experiment.stages.evaluate import evaluate_argmax
from see2act.experiment.stages.finetune import finetune
from see2act.experiment.stages.pretrain import QUALITY, VisionCheckpoint, vision_model
from see2act.experiment.stages.transfer import affordance_model
from see2act.files import write_json
from see2act.modules.affordance import AffordanceModule
from see2act.modules.transfer import copy_parts
from see2act.robot.types import Split

log = logging.getLogger("see2act")
STAGES = ("collect", "pretrain", "transfer", "finetune", "evaluate")


def run(cfg: DictConfig, folder: Path) -> RunResult:
    """Collect, pre-train, transfer, fine-tune, evaluate.

    Args:
        cfg: A validated configuration.
        folder: Where everything goes. An unfinished run of the same configuration in it is continued.
    """
    context = RunContext(cfg, folder)
    context.dashboard = Dashboard.of(cfg, folder, context.title)
    try:
        result = _stages(context)
    except BaseException:  # Ctrl-C too
        context.dashboard.close(failed=True)
        raise
    context.dashboard.close()
    return result


def _stages(context: RunContext) -> RunResult:
    cfg, progress = context.cfg, context.progress

    def make_trainer(**more: Any) -> L.Trainer:
        return build.trainer(cfg, context.folder, context.dashboard.logger, **more)

    collects = build.needs_observations(cfg)
    if attended(cfg):
        log.info(refills(context, scenes_left(cfg) if collects else 0))
    with _stage(context, "collect"):
        collection = collected(cfg) if collects else None
    with _stage(context, "pretrain"):
        vision = vision_model(cfg, collection, make_trainer)
        _keep_vision_model(context, vision)
    with progress.timed("figures"):
        _draw_seeing(context, collection, vision)
    with _stage(context, "transfer"):
        module, report = affordance_model(cfg, collection, vision)
        write_json(context.folder / "transfer.json", report.as_dict())
        log.info(report.summary())
    del collection  # it may be a gigabyte, and what follows takes long
    before = copy.deepcopy(module)
    with _stage(context, "finetune"):
        finetune(context, module, make_trainer)
        model_file.save(context.checkpoints / model_file.FILE, module.acting, cfg)
    with _stage(context, "evaluate"):
        evaluate_argmax(context, module)
    with progress.timed("figures"):
        _draw_acting(context, vision, before, module)
    context.dashboard.show(context.folder)
    return _finish(context)


@contextmanager
def _stage(context: RunContext, name: str) -> Iterator[None]:
    """Say which stage begins, and count its seconds."""
    log.info("stage %d of %d: %s", STAGES.index(name) + 1, len(STAGES), name)
    with context.progress.timed(name):
        yield


def _keep_vision_model(context: RunContext, vision: VisionCheckpoint | None) -> None:
    if vision is None or context.cfg.task.affordance:
        return
    if set(QUALITY) <= set(vision):
        context.progress.vision = VisionQuality(**{key: vision[key] for key in QUALITY})
        context.progress.save()
    save_checkpoint(context.checkpoints / "vision.ckpt", vision)


def _draw_seeing(context: RunContext, collection: Collection | None, vision: VisionCheckpoint | None) -> None:
    """Labels, and what the vision model makes of other scenes: there to be looked at while the robot learns."""
    cfg, out, count = context.cfg, context.figures, context.cfg.figures.scenes
    if cfg.task.label is not None and collection:
        figures.labels(collection, build.task(cfg), cfg.labels, cfg.task.name, count, out / "labels.png")
    if quality := context.progress.vision:
        assert vision is not None
        network = build.network(cfg, 0)
        network.load_state_dict(vision["network"])
        title = f"{cfg.task.name}, average precision {quality.average_precision:.2f} on held-out scenes"
        figures.vision(held_out(cfg), build.task(cfg), cfg.labels, network, count, title, out / "vision.png")


def _draw_acting(
    context: RunContext, vision: VisionCheckpoint | None, before: AffordanceModule, module: AffordanceModule
) -> None:
    """How learning went, and what the models make of test scenes."""
    cfg, out, rows = context.cfg, context.figures, attempts.read(context.log.path)
    charts.learning_curve(rows, out / "learning_curve.png", context.title)
    charts.diagnosis(rows, out / "diagnosis.png", context.title)
    models = {"before fine-tuning": before, "after fine-tuning": module}
    if vision and not cfg.task.affordance and (seeing := _whole(cfg, vision, before)):
        models = {f"vision model: {cfg.task.name}": seeing, **models}
    robot = build.robot_factory(cfg, cfg.primitive)()
    try:
        if robot.attended:
            made = _evaluated(context, rows)
        else:
            made = figures.first_attempts(robot, module.affordances, build.policy(cfg), cfg.figures.scenes, cfg.evaluate.scenes)
        figures.heatmaps(made, models, robot, context.title, out)
    finally:
        robot.close()


def _evaluated(context: RunContext, rows: Sequence[attempts.AttemptRow]) -> list[tuple[Split, Attempt]]:
    """The first attempt of each test run of the last evaluation, from the records: a person need not fill the bin again."""
    first: dict[tuple[Split, int], str] = {}
    policy = context.cfg.policy.name
    tested = [row for row in rows if row.phase in attempts.TESTED and (row.policy, row.step) == (policy, context.attempts)]
    for k, row in enumerate(tested):
        first.setdefault((row.split, row.run), testing(row.phase, row.step, policy, k + 1))
    loaded = [(split, context.records.load(name)) for (split, _), name in first.items()]
    return [(split, attempt) for split, attempt in loaded if attempt is not None]


def _whole(cfg: DictConfig, vision: VisionCheckpoint, before: AffordanceModule) -> AffordanceModule | None:
    """The vision model with all of its parts, to be drawn; None if a part that was not transferred does not fit."""
    whole = copy.deepcopy(before)
    try:
        copy_parts(vision["network"], whole.network, cfg.task.parts, cfg.task.optional, cfg.task.zero)
    except TransferError as error:
        log.info("figures: heatmaps.png has no column of the vision model: %s", error)
        return None
    return whole


def _finish(context: RunContext) -> RunResult:
    cfg, progress = context.cfg, context.progress
    last, seconds = progress.evaluations[context.attempts], progress.seconds
    choices = {key: cfg[key].name for key in CHOICES}
    choices |= {"labels": cfg.labels, "seed": cfg.seed, "precision": cfg.precision, "motion": cfg.robot.get("motion")}
    result = RunResult(
        choices=choices,
        config_hash=config_hash(cfg),
        versions=versions(),
        earlier_versions=tuple(earlier_versions(context.folder)),
        commit=commit(),
        seconds=seconds,
        evaluation_share=round(seconds.get("evaluate", 0.0) / max(sum(seconds.values()), 0.1), 3),
        vision=progress.vision,
        zero_shot=progress.evaluations.get(0),
        eval=last if context.attempts else last.model_copy(update={"repeated": True}),
        eval_argmax=progress.argmax,
        evals=tuple(StepEvaluation(step=step, **dict(evaluation)) for step, evaluation in sorted(progress.evaluations.items())),
        curve=curve(attempts.read(context.log.path)),
    )
    write_result(context.folder / "result.json", result)
    (context.folder / "progress.json").unlink()
    return result
