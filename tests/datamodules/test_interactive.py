"""Trial and error as a data module: whose turn it is, when a scene ends, and how it goes on after an interruption."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch

from see2act.datamodules.interactive import InteractiveDataModule, TrainingAttempt
from see2act.datamodules.replay import Replay
from see2act.datamodules.trial_and_error import TrialAndError
from see2act.modules.affordance import AttemptBatch
from see2act.policy import Policy
from see2act.robot.group import RobotGroup
from see2act.robot.types import Pick, RobotError
from see2act.seeding import generator, seed_for
from tests.datamodules.cells import WORKSPACE, Cells


def _heights(color: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Prefers what is high, but not by much, and never the cell that is out of order."""
    logits = 20 * height[None].copy()
    logits[0, 7, 7] = -100
    return logits


@pytest.fixture
def make() -> Iterator[Callable[..., InteractiveDataModule]]:
    groups: list[RobotGroup] = []

    def made(robots: int = 1, seed: int = 0, temperature: float = 0.05, **more: Any) -> InteractiveDataModule:
        groups.append(RobotGroup(Cells, robots))
        replay = Replay(
            alpha=0.6,
            beta=0.4,
            floor=0.01,
            mirror=False,
            rotation=0.0,
            shift=0.0,
            color_jitter=0.0,
            pixel=0.0025,
            rng=generator("replay", seed),
        )
        policy = Policy("suppress", True, 0.0025, radius=0.002, changed_radius=0.0025)
        settings = {"seed": seed, "batch_size": 4, "updates": 2, "temperature": temperature, "episode_attempts": 6}
        return InteractiveDataModule(groups[-1], WORKSPACE, policy, replay, **settings, **more)

    yield made
    for group in groups:
        group.close()


def _played(data: InteractiveDataModule, epochs: int) -> list[tuple]:
    """Episode, pick and success of each attempt."""
    made = []
    for _ in range(epochs):
        data.start_episodes()
        observations = data.observe()
        decisions = data.decide(observations, _heights)
        attempts = data.remember(observations, decisions, data.act(decisions), [0.0, 0.0, 0.0])
        made += [(each.episode, each.attempt.pick, each.attempt.outcome.success) for each in attempts]
    return made


def test_training_scenes_to_choose_settings_by_are_not_the_benchmark_s(make: Callable[..., InteractiveDataModule]) -> None:
    benchmark = {make(seed=seed).scene_seed(0) for seed in range(5)}
    assert benchmark == {seed_for("scene/finetune", seed, 0) for seed in range(5)}
    assert not benchmark & {make(seed=seed, scenes="develop").scene_seed(0) for seed in range(5)}


def test_an_episode_ends_when_the_bin_is_empty_or_its_attempts_are_spent(make: Callable[..., InteractiveDataModule]) -> None:
    made = _played(make(), 60)
    episodes = [[success for e, _, success in made if e == episode] for episode in range(made[-1][0])]
    assert len(episodes) > 8
    for successes in episodes:
        assert (sum(successes) == 3 and successes[-1]) or len(successes) == 6
    assert any(sum(successes) == 3 for successes in episodes)
    assert any(sum(successes) < 3 for successes in episodes)


def test_draws_widen_while_recent_attempts_fail(make: Callable[..., InteractiveDataModule]) -> None:
    data = make(temperature=0.02, widening=5.0)
    cell = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), 0, 0, 0
    assert data.temperature == pytest.approx(0.02)
    for _ in range(10):
        data.replay.add(*cell, False)
    assert data.temperature == pytest.approx(0.02)  # ten are yet to come, and may succeed
    for _ in range(10):
        data.replay.add(*cell, False)
    assert data.temperature == pytest.approx(0.1)
    for _ in range(2):
        data.replay.add(*cell, True)
    assert data.temperature == pytest.approx(0.02 * 3.4)  # s = 0.1
    for _ in range(3):
        data.replay.add(*cell, True)
    assert data.temperature == pytest.approx(0.02)  # one in four
    for _ in range(20):
        data.replay.add(*cell, False)
    assert data.temperature == pytest.approx(0.1)  # old successes do not count


def test_temperature_zero_stays_zero_whatever_fails(make: Callable[..., InteractiveDataModule]) -> None:
    data = make(temperature=0.0, widening=5.0)
    for _ in range(20):
        data.replay.add(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), 0, 0, 0, False)
    assert data.temperature == 0.0


def test_what_failed_is_left_alone_within_an_episode_and_no_longer(make: Callable[..., InteractiveDataModule]) -> None:
    data = make(temperature=0.0)
    policy, failures = data._bins[0].policy, []
    forget = policy.forget
    policy.forget = lambda: (failures.append(len(policy._failures)), forget())
    made = _played(data, 30)
    assert len(failures) == data._next_episode
    assert any(failures)
    for (episode, pick, success), (next_episode, next_pick, _) in pairwise(made):
        if episode == next_episode and not success:
            assert (pick.row, pick.col) != (next_pick.row, next_pick.col)


def test_robots_side_by_side_take_scenes_in_turn_and_are_remembered_in_order(
    make: Callable[..., InteractiveDataModule],
) -> None:
    data = make(robots=3)
    made = _played(data, 8)
    assert data.attempts == 24 == len(data.replay)
    assert [episode for episode, *_ in made[:3]] == [0, 1, 2]
    assert sorted({episode for episode, *_ in made}) == list(range(data._next_episode))
    assert data.replay._items["row"] == [pick.row for _, pick, _ in made]
    assert len(data.train_dataloader()) == 6
    assert made == _played(make(robots=3), 8)


def test_each_robot_lives_in_a_process_of_its_own() -> None:
    group = RobotGroup(Cells, 3)
    processes = group.call("process", dict.fromkeys(range(3), ()))
    group.close()
    assert len({*processes.values(), os.getpid()}) == 4
    alone = RobotGroup(Cells, 1)
    assert alone.call("process", {0: ()}) == {0: os.getpid()}


@pytest.mark.parametrize("robots", [1, 3])
def test_a_run_that_is_taken_up_goes_on_as_if_it_had_not_been_interrupted(
    make: Callable[..., InteractiveDataModule], robots: int
) -> None:
    whole = make(robots)
    middle_of_episodes = 0
    kept = []
    for _ in range(12):
        _played(whole, 1)
        kept.append((whole.state_dict(), whole.attempts))
        middle_of_episodes += any(not bin.over for bin in whole._bins)
    assert middle_of_episodes > 3
    rest = _played(whole, 4)
    for state, attempts in kept[::4]:
        again = make(robots)
        again.load_state_dict(state)
        assert again.attempts == attempts
        assert _played(again, (12 * robots - attempts) // robots + 4)[-len(rest) :] == rest


def test_an_error_of_a_robot_is_told_here_and_the_others_are_still_of_use() -> None:
    group = RobotGroup(Cells, 2)
    group.call("reset", {0: (0, "seen"), 1: (1, "seen")})
    broken, fine = Pick(7, 7, 0.0, 0.0, 0.0, 0.0), Pick(0, 0, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(RobotError, match="out of order"):
        group.call("execute", {0: (broken,), 1: (fine,)})
    assert set(group.call("bin_empty", {0: (), 1: ()})) == {0, 1}
    group.close()


def test_a_robot_whose_process_is_gone_ends_the_run_with_a_message() -> None:
    group = RobotGroup(Cells, 2)
    processes = group.call("process", {0: (), 1: ()})
    os.kill(processes[1], signal.SIGKILL)
    with pytest.raises(RobotError, match="process of a robot has ended"):
        group.call("process", {0: (), 1: ()})
    group.close()


class Learner(L.LightningModule):
    """A model of one number, which says in ``events`` what happens to it and when."""

    def __init__(self, events: list[str]):
        super().__init__()
        self.bias = torch.nn.Parameter(torch.zeros(()))
        self._events = events

    def affordances(self, color: np.ndarray, height: np.ndarray) -> np.ndarray:
        self._events.append("decide")
        return _heights(color, height)

    def training_step(self, batch: AttemptBatch, _: int) -> dict[str, torch.Tensor]:
        self._events.append("learn")
        error = self.bias - batch.label
        return {"loss": (error**2).mean(), "td_error": torch.full_like(batch.label, 7.0)}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.fixture
def learned(make: Callable[..., InteractiveDataModule], tmp_path: Path) -> Callable[..., Any]:
    """Runs the learning loop; the datamodule, what happened, and what was recorded."""

    def run(attempts: int, robots: int = 1, evaluate_at: list[int] | None = None, resume: Path | None = None) -> Any:
        data, events, recorded = make(robots), [], []

        def record(attempt: TrainingAttempt, seconds: float) -> None:
            events.append("record")
            recorded.append(attempt)

        def evaluate(step: int) -> None:
            events.append(f"evaluate {step}")

        loop = TrialAndError(data, attempts, record, tmp_path / "last.ckpt", evaluate_at or [], evaluate)
        trainer = L.Trainer(
            **{"max_epochs": attempts // robots, "callbacks": [loop], "accelerator": "cpu", "logger": False},
            **{"enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False},
        )
        trainer.fit(Learner(events), datamodule=data, ckpt_path=resume, weights_only=True)
        return data, events, recorded

    return run


def test_an_epoch_is_an_attempt_and_the_learning_steps_after_it(learned: Callable[..., Any]) -> None:
    data, events, recorded = learned(4, evaluate_at=[2])
    epoch = ["decide", "learn", "learn", "record"]
    assert events == [*epoch, *epoch, "evaluate 2", *epoch, *epoch]
    assert [attempt.step for attempt in recorded] == [1, 2, 3, 4]
    assert len(data.replay) == data.attempts == 4


def test_robots_decide_one_after_the_other_and_learn_together(learned: Callable[..., Any]) -> None:
    data, events, recorded = learned(6, robots=3)
    assert events == [*["decide"] * 3, *["learn"] * 6, *["record"] * 3] * 2
    assert [attempt.step for attempt in recorded] == [1, 2, 3, 4, 5, 6]
    assert [attempt.episode for attempt in recorded[:3]] == [0, 1, 2]
    assert recorded[1].scene_seed == data.scene_seed(1)


def test_the_td_errors_of_a_step_become_priorities(learned: Callable[..., Any]) -> None:
    data, _, _ = learned(3)
    assert data.replay.statistics(np.array([2]))["priority"] == pytest.approx(7.01)


def test_a_checkpoint_is_written_when_an_episode_ends_and_learning_goes_on_from_it(
    learned: Callable[..., Any], tmp_path: Path
) -> None:
    _, _, whole = learned(20)
    kept = torch.load(tmp_path / "last.ckpt", weights_only=True)["InteractiveDataModule"]
    last = [attempt.step for attempt, after in pairwise(whole) if attempt.episode != after.episode][-1]
    assert kept["attempts"] == last < 20
    data, events, rest = learned(20, resume=tmp_path / "last.ckpt")
    assert data.attempts == 20
    assert events.count("decide") == 20 - last
    assert [(a.step, a.episode, a.attempt.pick) for a in rest] == [(a.step, a.episode, a.attempt.pick) for a in whole[last:]]
