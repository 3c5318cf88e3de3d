"""Trial and error: robots attempt picks with the current model, and the model learns from their outcomes.

:class:`TrialAndError` is the learning loop. It works on an :class:`InteractiveDataModule`, which holds the robots, what is
going on in their bins, and the replay.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
from tqdm import tqdm

from see2act.attempt import Affordances, Attempt, decide
from see2act.datamodules.replay import Replay
from see2act.files import replacing
from see2act.modules.affordance import AffordanceModule, AttemptBatch
from see2act.policy import Choice, Policy
from see2act.robot.group import RobotGroup
from see2act.robot.types import Observation, Outcome, Pick
from see2act.robot.workspace import Workspace
from see2act.seeding import generator, seed_for

RECENT = 20
"""Attempts over which the logged success rate is taken."""
Decision = tuple[Choice, Pick]


@dataclass(frozen=True)
class TrainingAttempt:
    """An attempt of the learning loop, and where it belongs."""

    attempt: Attempt
    step: int
    """Its number, from 1."""
    episode: int
    scene_seed: int


class TrialAndError(L.Callback):
    """The learning loop. One epoch of the trainer is one attempt of each robot and the learning steps that follow it.

    Args:
        data: The trainer's datamodule.
        attempts: How many there will be.
        record: Called with each attempt and the seconds of learning it took.
        checkpoint: Written whenever an episode ends.
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
        data, clock = self._data, [time.perf_counter()]
        data.start_episodes()
        observations = data.observe()
        clock.append(time.perf_counter())
        decisions = data.decide(observations, module.affordances)
        clock.append(time.perf_counter())
        outcomes = data.act(decisions)
        clock.append(time.perf_counter())
        self._made = data.remember(observations, decisions, outcomes, [after - before for before, after in pairwise(clock)])
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
        if data.an_episode_is_over and data.attempts < self._attempts:
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
                **{f"replay/{name}": value for name, value in self._data.replay.statistics(self._drawn).items()},
            }
        )
        self._bar.set_postfix(success=f"{success:.2f}", refresh=False)
        self._bar.update(len(self._made))


@dataclass
class _Bin:
    """What is going on at one robot."""

    policy: Policy
    episode: int = -1
    decisions: list[Decision] = field(default_factory=list)
    """Of the present episode so far."""
    over: bool = True
    """Whether the next attempt starts with a new scene."""


class InteractiveDataModule(L.LightningDataModule):
    """Robots, the state of their bins, and the replay that learning steps draw from.

    Robots act at the same time. Their attempts are remembered in the order of their numbers, and a robot whose episode is over
    takes the next scene. So everything follows from the seed and the number of robots.

    Args:
        robots: Act in scenes of seen objects.
        workspace: Theirs.
        policy: The rule for picks.
        replay: Remembers attempts.
        seed: The run's seed; scenes and exploration follow from it.
        batch_size: Attempts per learning step.
        updates: Learning steps per attempt.
        temperature: Of the softmax over scores that picks are drawn from; 0 takes the best.
        episode_attempts: Attempts after which a bin that is not yet empty is given up.
        scenes: ``evaluate`` for the benchmark's scenes, ``develop`` for others, to choose settings by.
    """

    def __init__(
        self,
        robots: RobotGroup,
        workspace: Workspace,
        policy: Policy,
        replay: Replay,
        *,
        seed: int,
        batch_size: int,
        updates: int,
        temperature: float,
        episode_attempts: int,
        scenes: str = "evaluate",
    ):
        super().__init__()
        self._robots, self._workspace, self.policy, self.replay = robots, workspace, policy, replay
        self._seed, self._batch_size, self._updates = seed, batch_size, updates
        self._temperature, self._episode_attempts = temperature, episode_attempts
        self._scenes = "scene/finetune" if scenes == "evaluate" else f"scene/{scenes}/finetune"
        self._explore = generator("explore", seed)
        self._bins = [_Bin(policy.fresh()) for _ in range(len(robots))]
        self._next_episode = 0
        self.attempts = 0
        """Attempts so far."""

    @property
    def an_episode_is_over(self) -> bool:
        """Whether a robot starts its next attempt with a new scene. Then a checkpoint needs the fewest picks repeated."""
        return any(bin.over for bin in self._bins)

    def start_episodes(self) -> None:
        """New scenes where an episode is over."""
        scenes: dict[int, tuple] = {}
        for i, bin in enumerate(self._bins):
            if bin.over:
                bin.episode, bin.decisions, bin.over = self._next_episode, [], False
                bin.policy.forget()
                self._next_episode += 1
                scenes[i] = (self.scene_seed(bin.episode), "seen")
        self._robots.call("reset", scenes)

    def observe(self) -> list[Observation]:
        """What each robot sees."""
        return list(self._robots.call("observe", self._everyone()).values())

    def decide(self, observations: list[Observation], affordances: Affordances) -> list[Decision]:
        """Where each robot picks next, by the model's affordances and the policy."""
        return [
            decide(observation, self._workspace, affordances, bin.policy, self._temperature, self._explore)
            for bin, observation in zip(self._bins, observations, strict=True)
        ]

    def act(self, decisions: list[Decision]) -> list[Outcome]:
        """Execute the picks, all robots at once."""
        return list(self._robots.call("execute", {i: (pick,) for i, (_, pick) in enumerate(decisions)}).values())

    def remember(
        self, observations: list[Observation], decisions: list[Decision], outcomes: list[Outcome], seconds: list[float]
    ) -> list[TrainingAttempt]:
        """Add the attempts to the replay, and end the episodes of bins that are empty or given up.

        Args:
            observations, decisions, outcomes: By robot.
            seconds: Wall time that observing, deciding and acting took, all robots together.
        """
        empty = self._robots.call("bin_empty", self._everyone())
        made = []
        for i, (bin, observation, (choice, pick), outcome) in enumerate(
            zip(self._bins, observations, decisions, outcomes, strict=True)
        ):
            heightmap = observation.heightmap
            bin.policy.remember(choice, heightmap, outcome.success)
            bin.decisions.append((choice, pick))
            bin.over = empty[i] or len(bin.decisions) >= self._episode_attempts
            self.replay.add(heightmap.color, heightmap.height, choice.angle, choice.row, choice.col, outcome.success)
            self.attempts += 1
            attempt = Attempt(observation, choice, pick, outcome, *(s / len(self._bins) for s in seconds))
            made.append(TrainingAttempt(attempt, self.attempts, bin.episode, self.scene_seed(bin.episode)))
        return made

    def train_dataloader(self) -> _ReplayBatches:
        return _ReplayBatches(self.replay, self._updates * len(self._bins), self._batch_size)

    def scene_seed(self, episode: int) -> int:
        """Seed of the scene of an episode."""
        return seed_for(self._scenes, self._seed, episode)

    def state_dict(self) -> dict[str, Any]:
        """Of a robot in the middle of an episode the picks so far: :meth:`load_state_dict` makes them again."""
        bins = [
            {
                "episode": bin.episode,
                "over": bin.over,
                "decisions": [] if bin.over else [[asdict(choice), asdict(pick)] for choice, pick in bin.decisions],
            }
            for bin in self._bins
        ]
        return {
            "replay": self.replay.state_dict(),
            "explore": self._explore.bit_generator.state,
            "attempts": self.attempts,
            "next_episode": self._next_episode,
            "bins": bins,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.replay.load_state_dict(state["replay"])
        self._explore.bit_generator.state = state["explore"]
        self.attempts, self._next_episode = state["attempts"], state["next_episode"]
        for bin, kept in zip(self._bins, state["bins"], strict=True):
            bin.episode, bin.over = kept["episode"], kept["over"]
            bin.decisions = [(Choice(**choice), Pick(**pick)) for choice, pick in kept["decisions"]]
        self._repeat_episodes()

    def _repeat_episodes(self) -> None:
        """Bring each robot to where it was within its episode, by the same picks in the same scene."""
        under_way = {i: bin for i, bin in enumerate(self._bins) if not bin.over}
        self._robots.call("reset", {i: (self.scene_seed(bin.episode), "seen") for i, bin in under_way.items()})
        for k in range(self._episode_attempts):
            going = {i: bin for i, bin in under_way.items() if k < len(bin.decisions)}
            observations = self._robots.call("observe", dict.fromkeys(going, ()))
            outcomes = self._robots.call("execute", {i: (bin.decisions[k][1],) for i, bin in going.items()})
            for i, bin in going.items():
                bin.policy.remember(bin.decisions[k][0], observations[i].heightmap, outcomes[i].success)

    def _everyone(self) -> dict[int, tuple]:
        return dict.fromkeys(range(len(self._bins)), ())


class _ReplayBatches:
    """The batches of an epoch. Without a length Lightning would fetch ahead, before a step has updated the priorities."""

    def __init__(self, replay: Replay, count: int, size: int):
        self._replay, self._count, self._size = replay, count, size

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[AttemptBatch]:
        for _ in range(self._count):
            yield self._replay.sample(self._size)
