"""The robots that learn, what is going on in their bins, and the replay; :mod:`.trial_and_error` is the loop around them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import lightning as L

from see2act.attempt import Affordances, Attempt, decide
from see2act.datamodules.records import Records, training
from see2act.datamodules.replay import Replay
from see2act.modules.affordance import AttemptBatch
from see2act.policy import Choice, Policy
from see2act.robot.group import RobotGroup
from see2act.robot.types import Observation, Outcome, Pick
from see2act.robot.workspace import Workspace
from see2act.seeding import generator, seed_for

Decision = tuple[Choice, Pick]
RECENT = 20
"""Attempts over which success while learning is followed."""
ENOUGH = 0.25
"""Success rate of recent attempts from which on draws are as narrow as configured."""


@dataclass(frozen=True)
class TrainingAttempt:
    """An attempt of the learning loop, and where it belongs."""

    attempt: Attempt
    step: int
    """Its number, from 1."""
    episode: int
    scene_seed: int


@dataclass
class _Bin:
    """What is going on at one robot."""

    policy: Policy
    episode: int = -1
    decisions: list[Decision] = field(default_factory=list)
    """Of the present episode so far."""
    over: bool = True
    """Whether the next attempt starts with a new scene."""
    doubtful: bool = False
    """Whether an interrupted run left the scene, and a person has not yet said that it is as it was."""


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
        widening: Factor on the temperature where all recent attempts failed: see :attr:`temperature`.
        episode_attempts: Attempts after which a bin that is not yet empty is given up.
        scenes: ``evaluate`` for the benchmark's scenes, ``develop`` for others, to choose settings by.
        records: Where attempts are kept that cannot be made again; None if they can.
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
        widening: float = 1.0,
        episode_attempts: int,
        scenes: str = "evaluate",
        records: Records | None = None,
    ):
        super().__init__()
        self._robots, self._workspace, self.policy, self.replay = robots, workspace, policy, replay
        self._seed, self._batch_size, self._updates = seed, batch_size, updates
        self._temperature, self._widening, self._episode_attempts = temperature, widening, episode_attempts
        self._scenes = "scene/finetune" if scenes == "evaluate" else f"scene/{scenes}/finetune"
        self._explore = generator("explore", seed)
        self._bins = [_Bin(policy.fresh()) for _ in range(len(robots))]
        self._next_episode = 0
        self._records = records
        self._recorded: Attempt | None = None
        """The attempt that comes next, where an interrupted run made it and did not learn from it."""
        self.attempts = 0
        """Attempts so far."""

    @property
    def is_worth_a_checkpoint(self) -> bool:
        """Whether a robot starts its next attempt with a new scene, so that the fewest picks would have to be repeated; after
        each attempt if none can be repeated."""
        return self._records is not None or any(bin.over for bin in self._bins)

    @property
    def temperature(self) -> float:
        """Of the next draw, higher while picks keep failing: a model that draws the same wrong kind of place again and again
        never learns what else would work.

        With s the success rate of the last ``RECENT`` attempts, of which those yet to come count as half a success, it is
        ``temperature`` times 1 + (``widening`` - 1) (1 - s / ``ENOUGH``) where s is below ``ENOUGH``.
        """
        made = min(len(self.replay), RECENT) / RECENT
        success = (1 - made) / 2 + (made * self.replay.success(RECENT) if made else 0.0)
        return self._temperature * (1 + (self._widening - 1) * max(0.0, 1 - success / ENOUGH))

    def start_episodes(self) -> None:
        """New scenes where an episode is over."""
        self._recorded = self._records.load(training(self.attempts + 1)) if self._records else None
        for bin in self._bins:
            if bin.doubtful and not self._recorded:
                as_it_was = self._robots.call("resume", {0: (self.scene_seed(bin.episode), len(bin.decisions))})[0]
                bin.doubtful, bin.over = False, not as_it_was
        scenes: dict[int, tuple] = {}
        for i, bin in enumerate(self._bins):
            if bin.over:
                bin.episode, bin.decisions, bin.over = self._next_episode, [], False
                bin.policy.forget()
                self._next_episode += 1
                scenes[i] = (self.scene_seed(bin.episode), "seen")
        if not self._recorded:
            self._robots.call("reset", scenes)

    def observe(self) -> list[Observation]:
        """What each robot sees."""
        if self._recorded:
            return [self._recorded.observation]
        return list(self._robots.call("observe", self._everyone()).values())

    def decide(self, observations: list[Observation], affordances: Affordances) -> list[Decision]:
        """Where each robot picks next, by the model's affordances and the policy."""
        if self._recorded:
            return [(self._recorded.choice, self._recorded.pick)]
        return [
            decide(observation, self._workspace, affordances, bin.policy, self.temperature, self._explore)
            for bin, observation in zip(self._bins, observations, strict=True)
        ]

    def act(self, decisions: list[Decision]) -> list[Outcome]:
        """Execute the picks, all robots at once."""
        if self._recorded:
            return [self._recorded.outcome]
        return list(self._robots.call("execute", {i: (pick,) for i, (_, pick) in enumerate(decisions)}).values())

    def remember(
        self, observations: list[Observation], decisions: list[Decision], outcomes: list[Outcome], seconds: list[float]
    ) -> list[TrainingAttempt]:
        """Add the attempts to the replay, and end the episodes of bins that are empty or given up.

        An aborted attempt is neither added nor counted. The policy takes it for a failure, and so chooses another pick.

        Args:
            observations, decisions, outcomes: By robot.
            seconds: Wall time that observing, deciding and acting took, all robots together.
        """
        attempts = [
            Attempt(observation, choice, pick, outcome, *(s / len(self._bins) for s in seconds))
            for observation, (choice, pick), outcome in zip(observations, decisions, outcomes, strict=True)
        ]
        self._keep(attempts)
        empty = self._robots.call("bin_empty", self._everyone())
        made = []
        for i, (bin, attempt) in enumerate(zip(self._bins, attempts, strict=True)):
            choice, heightmap, outcome = attempt.choice, attempt.heightmap, attempt.outcome
            bin.policy.remember(choice, heightmap, outcome.success)
            if not outcome.aborted:
                bin.decisions.append((choice, attempt.pick))
                bin.over = empty[i] or len(bin.decisions) >= self._episode_attempts
                self.replay.add(heightmap.color, heightmap.height, choice.angle, choice.row, choice.col, outcome.success)
                self.attempts += 1
            made.append(TrainingAttempt(attempt, self.attempts, bin.episode, self.scene_seed(bin.episode)))
        return made

    def _keep(self, attempts: list[Attempt]) -> None:
        """Of a robot whose attempts cannot be made again, write the one that it has just made."""
        if self._records and not self._recorded:
            (attempt,) = attempts
            if attempt.outcome.aborted:
                self._records.save_aborted(self.attempts + 1, attempt)
            else:
                self._records.save(training(self.attempts + 1), attempt)

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
        if self._records:
            self._recall_episode()
        else:
            self._repeat_episodes()

    def _recall_episode(self) -> None:
        """Bring the policy's memory to where it was within the episode, from the records."""
        (bin,) = self._bins
        bin.doubtful = not bin.over
        for k, (choice, _) in enumerate(bin.decisions):
            record = self._records.load(training(self.attempts - len(bin.decisions) + 1 + k)) if self._records else None
            if record:
                bin.policy.remember(choice, record.heightmap, record.outcome.success)

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
