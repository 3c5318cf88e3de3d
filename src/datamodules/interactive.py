"""Trial and error: the datamodule acts, and what happened becomes training data."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
from torch import Tensor
from tqdm import tqdm

from see2act.attempt import Affordances, Attempt, decide
from see2act.datamodules.replay import Replay
from see2act.files import replacing
from see2act.policy import Choice, Policy
from see2act.robot.group import RobotGroup
from see2act.robot.types import Pick
from see2act.robot.workspace import Workspace
from see2act.seeding import generator, seed_for

RECENT = 20
"""Attempts over which the log's success rate is taken."""


@dataclass
class _Bin:
    """What is going on at one robot."""

    policy: Policy
    episode: int = -1
    choices: list[tuple[Choice, Pick]] = field(default_factory=list)
    """Of its present episode, so far."""
    over: bool = True
    """Whether the next attempt starts with a new scene."""


class InteractiveDataModule(L.LightningDataModule):
    """In an epoch each robot tries once with the current model, then replay batches follow.

    Robots try at the same time, their attempts are remembered in the order of their numbers, and a robot whose episode is
    over takes the next scene. So all of it follows from the seed and the number of robots.

    Args:
        robots: Act in scenes of seen objects.
        workspace: Theirs.
        policy: The rule for picks.
        replay: Remembers attempts.
        seed: The run's seed; scenes and exploration follow from it.
        batch_size: Transitions a learning step.
        updates: Learning steps for each attempt.
        temperature: Of the softmax over scores that picks are drawn from; 0 takes the best.
        episode_attempts: Attempts after which a bin that is not yet empty is given up.
        scenes: Which scenes: ``evaluate`` for the benchmark's, ``develop`` for others, to choose settings by.
    """

    def __init__(
        self,
        robots: RobotGroup,
        workspace: Workspace,
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
        self._robots, self._workspace, self.policy, self.replay = robots, workspace, policy, replay
        self._seed, self._batch_size, self._updates = seed, batch_size, updates
        self._temperature, self._episode_attempts = temperature, episode_attempts
        self._scenes = "scene/finetune" if scenes == "evaluate" else f"scene/{scenes}/finetune"
        self._explore = generator("explore", seed)
        self._bins = [_Bin(policy.fresh()) for _ in range(len(robots))]
        self._next_episode = 0
        self.attempts = 0
        """Attempts so far."""
        self.last: list[tuple[Attempt, int]] = []
        """Attempts of the last epoch, with the episode of each."""

    @property
    def an_episode_is_over(self) -> bool:
        """Whether a robot starts its next attempt with a new scene: when it is worth to write down where to go on."""
        return any(bin.over for bin in self._bins)

    @property
    def updates(self) -> int:
        """Learning steps in an epoch."""
        return self._updates * len(self._bins)

    def scene_seed(self, episode: int) -> int:
        """Of the scene of an episode."""
        return seed_for(self._scenes, self._seed, episode)

    def act(self, affordances: Affordances) -> None:
        """One attempt of each robot: observe, decide, act, remember."""
        self._fill_bins()
        everyone = range(len(self._bins))
        start = time.perf_counter()
        observations = self._robots.call("observe", dict.fromkeys(everyone, ()))
        seen = time.perf_counter()
        for i, bin in enumerate(self._bins):
            bin.choices.append(
                decide(observations[i], self._workspace, affordances, bin.policy, self._temperature, self._explore)
            )
        decided = time.perf_counter()
        outcomes = self._robots.call("execute", {i: (bin.choices[-1][1],) for i, bin in enumerate(self._bins)})
        acted = time.perf_counter()
        empty = self._robots.call("bin_empty", dict.fromkeys(everyone, ()))
        each = [(later - before) / len(self._bins) for before, later in pairwise((start, seen, decided, acted))]
        self.last = []
        for i, bin in enumerate(self._bins):
            (choice, pick), heightmap, outcome = bin.choices[-1], observations[i].heightmap, outcomes[i]
            bin.policy.remember(choice, heightmap, outcome.success)
            self.replay.add(heightmap.color, heightmap.height, choice.angle, choice.row, choice.col, outcome.success)
            self.last.append((Attempt(observations[i], choice, pick, outcome, *each), bin.episode))
            bin.over = empty[i] or len(bin.choices) >= self._episode_attempts
        self.attempts += len(self._bins)

    def train_dataloader(self) -> _ActThenReplay:
        return _ActThenReplay(self)

    def state_dict(self) -> dict[str, Any]:
        """Of a robot in the middle of an episode the picks so far: :meth:`load_state_dict` makes them again."""
        bins = [
            {"episode": bin.episode, "over": bin.over, "choices": [] if bin.over else [_plain(*made) for made in bin.choices]}
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
            bin.choices = [(Choice(**choice), Pick(**pick)) for choice, pick in kept["choices"]]
        self._make_again()

    def batches(self, affordances: Affordances) -> Iterator[dict[str, Tensor]]:
        """The attempts of an epoch, then its learning batches."""
        self.act(affordances)
        for _ in range(self.updates):
            yield self.replay.sample(self._batch_size)

    def _fill_bins(self) -> None:
        """New scenes where an episode is over."""
        scenes: dict[int, tuple] = {}
        for i, bin in enumerate(self._bins):
            if bin.over:
                bin.episode, bin.choices, bin.over = self._next_episode, [], False
                bin.policy.forget()
                self._next_episode += 1
                scenes[i] = (self.scene_seed(bin.episode), "seen")
        self._robots.call("reset", scenes)

    def _make_again(self) -> None:
        """Bring each robot to where it was within its episode, by the same picks in the same scene."""
        under_way = {i: bin for i, bin in enumerate(self._bins) if not bin.over}
        self._robots.call("reset", {i: (self.scene_seed(bin.episode), "seen") for i, bin in under_way.items()})
        for k in range(self._episode_attempts):
            going = {i: bin for i, bin in under_way.items() if k < len(bin.choices)}
            observations = self._robots.call("observe", dict.fromkeys(going, ()))
            outcomes = self._robots.call("execute", {i: (bin.choices[k][1],) for i, bin in going.items()})
            for i, bin in going.items():
                bin.policy.remember(bin.choices[k][0], observations[i].heightmap, outcomes[i].success)


def _plain(choice: Choice, pick: Pick) -> list[dict[str, Any]]:
    return [asdict(choice), asdict(pick)]


class _ActThenReplay:
    """What Lightning iterates over. It has a length, so that Lightning does not fetch ahead with a stale model."""

    def __init__(self, data: InteractiveDataModule):
        self._data = data

    def __len__(self) -> int:
        return self._data.updates

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        assert self._data.trainer is not None
        module: Any = self._data.trainer.lightning_module
        return self._data.batches(module.affordances)


class TrialAndError(L.Callback):
    """What happens around the learning steps: priorities, log, evaluation, checkpoints.

    Args:
        data: The datamodule.
        attempts: How many there will be.
        record: Called with each attempt, the seconds of learning it took, and where it belongs in the log.
        checkpoint: Written whenever an episode ends.
        evaluate_at: Attempts after which ``evaluate`` is called with the number of attempts.
        evaluate: Measures the present model; must not touch the datamodule's robot or generators.
        primitive: For the log.
    """

    def __init__(
        self,
        data: InteractiveDataModule,
        attempts: int,
        record: Callable[..., object],
        checkpoint: Path,
        evaluate_at: list[int],
        evaluate: Callable[[int], None],
        primitive: str,
    ):
        self._data, self._attempts, self._record = data, attempts, record
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
        data, results = self._data, self._data.last
        t_learn = (time.perf_counter() - self._learning_since) / len(results)
        for step, (result, episode) in enumerate(results, data.attempts - len(results) + 1):
            self._record(
                result,
                t_learn,
                phase="finetune",
                split="seen",
                policy=data.policy.name,
                run=0,
                step=step,
                episode=episode,
                scene_seed=data.scene_seed(episode),
                primitive=self._primitive,
            )
        recent = data.replay.success(RECENT)
        choices = [result.choice for result, _ in results]
        measured = {
            "success": recent,
            "score": fmean(choice.score for choice in choices),
            "entropy": fmean(choice.entropy for choice in choices),
        }
        module.log_dict({f"affordance/{name}": value for name, value in measured.items()})
        module.log_dict({f"replay/{name}": value for name, value in data.replay.last_draw().items()})
        self._bar.set_postfix(success=f"{recent:.2f}", refresh=False)
        self._bar.update(len(results))
        if data.attempts in self._evaluate_at:
            self._evaluate(data.attempts)
        if data.an_episode_is_over and data.attempts < self._attempts:
            with replacing(self._checkpoint) as partial:  # a kill while writing must not cost the run
                trainer.save_checkpoint(partial)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._bar.close()
