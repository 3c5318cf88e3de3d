"""Stage 4: trial and error, with evaluations before, on the way, and after."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
from hydra.utils import instantiate

from see2act.datamodules.interactive import InteractiveDataModule, TrainingAttempt
from see2act.datamodules.records import Records
from see2act.datamodules.replay import Replay
from see2act.datamodules.trial_and_error import TrialAndError
from see2act.errors import ConfigError
from see2act.experiment import build
from see2act.experiment.attempts import AttemptRow, Place
from see2act.experiment.attended import attended
from see2act.experiment.checkpoints import load_checkpoint, save_checkpoint
from see2act.experiment.context import RunContext
from see2act.experiment.stages.evaluate import evaluate_at
from see2act.files import replacing
from see2act.modules.affordance import AffordanceModule
from see2act.robot.group import RobotGroup
from see2act.seeding import generator


def finetune(context: RunContext, module: AffordanceModule, make_trainer: Callable[..., L.Trainer]) -> None:
    """Let the model learn from its own attempts, from where an interrupted run left off.

    Afterwards ``module`` has the parameters of the last step, and ``checkpoints/affordance.ckpt`` too.
    """
    progress, last = context.progress, context.checkpoints / "last.ckpt"
    kept = context.checkpoints / "affordance.ckpt"
    done = _attempts_in(last)
    steps = context.evaluated_at
    if not progress.finetuned:
        progress.forget_evaluations([step for step in steps if step > done])
    context.log.begin(lambda row: _counts(context, row, done))
    if 0 in steps:
        evaluate_at(context, module, 0)
    if not context.attempts:
        save_checkpoint(kept, {"state_dict": module.state_dict()})
    elif progress.finetuned:
        module.load_state_dict(load_checkpoint(kept, ("state_dict",), module.network.device)["state_dict"])
    else:
        learn(context, module, make_trainer, last if last.exists() else None, steps)


def _attempts_in(checkpoint: Path) -> int:
    """Attempts after which a checkpoint was written; 0 without one."""
    if not checkpoint.exists():
        return 0
    replayed = InteractiveDataModule.__name__
    return int(load_checkpoint(checkpoint, (replayed, "state_dict"))[replayed]["attempts"])


def _counts(context: RunContext, row: AttemptRow, done: int) -> bool:
    """Whether a row of an interrupted run's log belongs to work that is not repeated."""
    if row.phase in ("finetune", "aborted"):
        return context.progress.finetuned or row.step <= done
    if attended(context.cfg):
        return True
    if row.policy != context.cfg.policy.name:
        return context.progress.argmax is not None
    return row.step in context.progress.evaluations


def learn(
    context: RunContext,
    module: AffordanceModule,
    make_trainer: Callable[..., L.Trainer],
    resume: Path | None,
    steps: list[int],
) -> None:
    """Make all attempts that are left.

    Args:
        context: Of the run.
        module: Learns.
        make_trainer: Builds the trainer.
        resume: Checkpoint of an interrupted run.
        steps: Attempts after which the model is evaluated.
    """
    cfg = context.cfg
    robots = RobotGroup(build.robot_factory(cfg, cfg.primitive), cfg.finetune.robots)
    try:
        data = interactive_data(cfg, robots, context.records)
        loop = TrialAndError(
            data,
            context.attempts,
            lambda made, t_learn: _log(context, made, t_learn),
            context.checkpoints / "last.ckpt",
            steps,
            lambda step: evaluate_at(context, module, step),
        )
        trainer = make_trainer(
            max_epochs=context.attempts // cfg.finetune.robots,
            callbacks=[loop],
            limit_val_batches=0,
            enable_progress_bar=False,
            **build.one_device(cfg),
        )
        module.train()  # Lightning keeps the mode it finds
        build.fit(trainer, module, data, ckpt_path=resume, weights_only=True)
        if data.attempts != context.attempts:
            raise ConfigError(
                f"the trainer ended after {data.attempts} of {context.attempts} attempts: trainer= has a key that ends it"
            )
        for name, weights_only in (("affordance", True), ("last", False)):
            with replacing(context.checkpoints / f"{name}.ckpt") as partial:
                trainer.save_checkpoint(partial, weights_only=weights_only)
    finally:
        robots.close()
    module.to(build.device(cfg))  # Lightning has brought it back to the processor
    context.progress.finetuned = True
    context.progress.save()


def interactive_data(cfg: Any, robots: RobotGroup, records: Records) -> InteractiveDataModule:
    """Robots, replay and exploration as configured; ``records`` are for an attended one."""
    return InteractiveDataModule(
        robots,
        instantiate(cfg.workspace),
        build.policy(cfg),
        Replay(**cfg.finetune.replay, pixel=cfg.workspace.pixel, rng=generator("replay", cfg.seed)),
        seed=cfg.seed,
        batch_size=cfg.finetune.batch_size,
        updates=cfg.finetune.updates,
        temperature=cfg.finetune.temperature,
        widening=cfg.finetune.widening,
        episode_attempts=cfg.finetune.episode_attempts,
        scenes=cfg.evaluate.scenes,
        records=records if robots.attended else None,
    )


def _log(context: RunContext, made: TrainingAttempt, t_learn: float) -> None:
    place = Place(
        "aborted" if made.attempt.outcome.aborted else "finetune",
        split="seen",
        policy=context.cfg.policy.name,
        run=0,
        step=made.step,
        episode=made.episode,
        scene_seed=made.scene_seed,
        primitive=context.cfg.primitive.name,
    )
    context.log.append(AttemptRow.of(made.attempt, place, t_learn))
