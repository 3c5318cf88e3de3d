"""Trial and error: the datamodule acts, and what happened becomes training data."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
from see2act.attempt import Affordances, Attempt, attempt
from see2act.attempts_csv import AttemptsCsv
from see2act.datamodules.replay import Replay
from see2act.files import replacing
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.seeding import generator, seed_for
from torch import Tensor
from tqdm import tqdm

RECENT = 20
"""Attempts over which the log's success rate is taken."""


class InteractiveDataModule(L.LightningDataModule):
    """One epoch is one attempt: the robot tries with the current model, then replay batches follow.

    Args:
        robot: Acts in scenes of seen objects.
        policy: The rule for picks.
        replay: Remembers attempts.
        seed: The run's seed; scenes and exploration follow from it.
        batch_size: Transitions a learning step.
        updates: Learning steps after each attempt.
        temperature: Of the softmax over scores that picks are drawn from; 0 takes the best.
        episode_attempts: Attempts after which a bin that is not yet empty is given up.
        scenes: Which scenes: ``evaluate`` for the benchmark's, ``develop`` for others, to choose settings by.
    """

    def __init__(
        self,
        robot: Robot,
        policy: Policy,
        replay: Replay,
        seed: int,
        batch_size: int,
        updates: int,
        temperature: float,
        episode_attempts: int,
        scenes: str = "evaluate",
    ):
        super().__init__()
        self._robot, self._policy, self.replay = robot, policy, replay
        self._seed, self._batch_size, self._updates = seed, batch_size, updates
        self._temperature, self._episode_attempts = temperature, episode_attempts
        self._scenes = "scene/finetune" if scenes == "evaluate" else f"scene/{scenes}/finetune"
        self._explore = generator("explore", seed)
        self.attempts = 0
        """Attempts so far."""
        self.episode = -1
        self._in_episode = 0
        self._episode_over = True
        self.last: Attempt | None = None

    @property
    def episode_over(self) -> bool:
        """Whether the next attempt starts with a new scene: the moments at which a run can be resumed."""
        return self._episode_over

    @property
    def scene_seed(self) -> int:
        """Of the present episode."""
        return seed_for(self._scenes, self._seed, self.episode)

    def act(self, affordances: Affordances) -> None:
        """One attempt: observe, decide, act, remember."""
        if self._episode_over:
            self.episode += 1
            self._in_episode = 0
            self._robot.reset(self.scene_seed, "seen")
            self._policy.forget()
        self.last = result = attempt(self._robot, affordances, self._policy, self._temperature, self._explore)
        heightmap, choice = result.heightmap, result.choice
        self.replay.add(heightmap.color, heightmap.height, choice.angle, choice.row, choice.col, result.outcome.success)
        self.attempts += 1
        self._in_episode += 1
        self._episode_over = self._robot.bin_empty() or self._in_episode >= self._episode_attempts

    def train_dataloader(self) -> _ActThenReplay:
        return _ActThenReplay(self)

    def state_dict(self) -> dict[str, Any]:
        return {
            "replay": self.replay.state_dict(),
            "explore": self._explore.bit_generator.state,
            "attempts": self.attempts,
            "episode": self.episode,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.replay.load_state_dict(state["replay"])
        self._explore.bit_generator.state = state["explore"]
        self.attempts, self.episode = state["attempts"], state["episode"]

    def batches(self, affordances: Affordances) -> Iterator[dict[str, Tensor]]:
        """The attempt of an epoch, then its learning batches."""
        self.act(affordances)
        for _ in range(self._updates):
            yield self.replay.sample(self._batch_size)


class _ActThenReplay:
    """What Lightning iterates over. It has a length, so that Lightning does not fetch ahead with a stale model."""

    def __init__(self, data: InteractiveDataModule):
        self._data = data

    def __len__(self) -> int:
        return self._data._updates

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        assert self._data.trainer is not None
        module: Any = self._data.trainer.lightning_module
        return self._data.batches(module.affordances)


class TrialAndError(L.Callback):
    """What happens around the learning steps: priorities, log, evaluation, checkpoints.

    Args:
        data: The datamodule.
        attempts: How many there will be.
        log: Where attempts are recorded.
        checkpoint: Written at the end of every episode.
        evaluate_at: Attempts after which ``evaluate`` is called with the number of attempts.
        evaluate: Measures the present model; must not touch the datamodule's robot or generators.
        primitive: For the log.
    """

    def __init__(
        self,
        data: InteractiveDataModule,
        attempts: int,
        log: AttemptsCsv,
        checkpoint: Path,
        evaluate_at: list[int],
        evaluate: Callable[[int], None],
        primitive: str,
    ):
        self._data, self._attempts, self._log = data, attempts, log
        self._checkpoint, self._evaluate_at, self._evaluate = checkpoint, evaluate_at, evaluate
        self._primitive = primitive

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar = tqdm(total=self._attempts, initial=self._data.attempts, desc="fine-tune", disable=None)

    def on_train_batch_start(self, trainer: L.Trainer, module: L.LightningModule, batch: Any, index: int) -> None:
        if index == 0:
            self._learning_since = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, outputs: Any, batch: Any, index: int) -> None:
        self._data.replay.update(module.surprise.cpu().numpy())

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        result = self._data.last
        assert result is not None
        t_learn = time.perf_counter() - self._learning_since
        step = self._data.attempts
        self._log.append(
            result,
            t_learn,
            phase="finetune",
            split="seen",
            policy=self._data._policy.name,
            run=0,
            step=step,
            episode=self._data.episode,
            scene_seed=self._data.scene_seed,
            primitive=self._primitive,
        )
        recent = self._data.replay.success(RECENT)
        measured = {
            "success": recent,
            "score": result.choice.score,
            "entropy": result.choice.entropy,
        }
        module.log_dict({f"affordance/{name}": value for name, value in measured.items()})
        module.log_dict({f"replay/{name}": value for name, value in self._data.replay.last_draw().items()})
        self._bar.set_postfix(success=f"{recent:.2f}", refresh=False)
        self._bar.update()
        if step in self._evaluate_at:
            self._evaluate(step)
        if self._data.episode_over and step < self._attempts:
            with replacing(self._checkpoint) as partial:  # a kill while writing must not cost the run
                trainer.save_checkpoint(partial)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar.close()
