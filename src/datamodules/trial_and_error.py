"""The learning loop: robots attempt picks with the current model, and the model learns from their outcomes."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
from tqdm import tqdm

from see2act.datamodules.interactive import RECENT, InteractiveDataModule, TrainingAttempt
from see2act.files import replacing
from see2act.modules.affordance import AffordanceModule, AttemptBatch


class TrialAndError(L.Callback):
    """The learning loop. One epoch of the trainer is one attempt of each robot and the learning steps that follow it.

    Args:
        data: The trainer's datamodule.
        attempts: How many there will be.
        record: Called with each attempt and the seconds of learning it took.
        checkpoint: Written whenever the data module says so.
        evaluate_at: Attempts after which ``evaluate`` is called with the number of attempts.
        evaluate: Measures the present model; must not touch the datamodule's robots or generators.
    """

    def __init__(
        self,
        data: InteractiveDataModule,
        attempts: int,
        record: Callable[[TrainingAttempt, float], object],
        checkpoint: Path,
        evaluate_at: list[int],
        evaluate: Callable[[int], None],
    ):
        self._data, self._attempts, self._record = data, attempts, record
        self._checkpoint, self._evaluate_at, self._evaluate = checkpoint, evaluate_at, evaluate

    def on_train_epoch_start(self, trainer: L.Trainer, module: AffordanceModule) -> None:  # type: ignore[override]
        """Observe, decide, act, remember. The learning steps of the epoch follow."""
        self._made: list[TrainingAttempt] = []
        while not self._made:  # an aborted attempt teaches nothing, and another one takes its place
            data, clock = self._data, [time.perf_counter()]
            data.start_episodes()
            observations = data.observe()
            clock.append(time.perf_counter())
            decisions = data.decide(observations, module.affordances)
            clock.append(time.perf_counter())
            outcomes = data.act(decisions)
            clock.append(time.perf_counter())
            made = data.remember(observations, decisions, outcomes, [after - before for before, after in pairwise(clock)])
            self._made = [each for each in made if not each.attempt.outcome.aborted]
            for aborted in (each for each in made if each.attempt.outcome.aborted):
                self._record(aborted, 0.0)
        self._learning_since = time.perf_counter()

    def on_train_batch_end(  # type: ignore[override]
        self, trainer: L.Trainer, module: L.LightningModule, outputs: dict[str, Any], batch: AttemptBatch, index: int
    ) -> None:
        """Learn: after each step on a batch of the replay, the batch gets new priorities."""
        self._drawn = batch.replay_index.cpu().numpy()
        self._data.replay.update(self._drawn, outputs["td_error"].cpu().numpy())

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Log, evaluate, save."""
        data, made = self._data, self._made
        seconds = (time.perf_counter() - self._learning_since) / len(made)
        for attempt in made:
            self._record(attempt, seconds)
        self._log(module)
        if data.attempts in self._evaluate_at:
            self._evaluate(data.attempts)
        if data.is_worth_a_checkpoint and data.attempts < self._attempts:
            with replacing(self._checkpoint) as partial:  # a kill while writing must not cost the run
                trainer.save_checkpoint(partial)

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar = tqdm(total=self._attempts, initial=self._data.attempts, desc="fine-tune", disable=None)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar.close()

    def _log(self, module: L.LightningModule) -> None:
        choices = [made.attempt.choice for made in self._made]
        success = self._data.replay.success(RECENT)
        module.log_dict(
            {
                "affordance/success": success,
                "affordance/score": fmean(choice.score for choice in choices),
                "affordance/entropy": fmean(choice.entropy for choice in choices),
                "affordance/temperature": self._data.temperature,
                **{f"replay/{name}": value for name, value in self._data.replay.statistics(self._drawn).items()},
            }
        )
        self._bar.set_postfix(success=f"{success:.2f}", refresh=False)
        self._bar.update(len(self._made))
