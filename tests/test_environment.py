"""The robot behind Gymnasium's door."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from see2act.errors import ConfigError

EXAMPLE = Path(__file__).parents[1] / "docs" / "gymnasium_example.py"
ENVIRONMENT = "see2act.environment:see2act/BinPicking-v1"


@pytest.mark.filterwarnings("error::UserWarning")  # the checks warn of what they do not like
@pytest.mark.parametrize("primitive", ["suction", "grasp"])
def test_gymnasium_s_own_checks_pass(primitive: str) -> None:
    env = gymnasium.make(ENVIRONMENT, overrides=[f"primitive={primitive}"], render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_the_example_picks_and_an_episode_ends() -> None:
    spec = importlib.util.spec_from_file_location("example", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    env = gymnasium.make(ENVIRONMENT, overrides=["primitive=suction"], split="unseen")
    observation, _ = env.reset(seed=1)
    total, steps, ended = 0.0, 0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(example.flat_and_high(observation))
        total, steps, ended = total + reward, steps + 1, terminated or truncated
        assert (info["cause"] == "ok") == bool(info["truth"])
    assert terminated or steps == 25
    assert total > 0
    env.close()


def test_a_seed_gives_the_same_scene_and_another_split_other_objects() -> None:
    env = gymnasium.make(ENVIRONMENT)
    first, again = (env.reset(seed=4)[0] for _ in range(2))
    np.testing.assert_array_equal(first["height"], again["height"])
    unseen, _ = env.reset(seed=4, options={"split": "unseen"})
    assert not np.array_equal(first["height"], unseen["height"])
    with pytest.raises(ValueError, match="choose one of seen, unseen"):
        env.reset(seed=4, options={"split": "both"})
    env.close()


@pytest.mark.parametrize("override", ["transfer=none", "primitive=foo", "nonsense=1", "objects=folder", "camera.focal=abc"])
def test_bad_configuration_is_refused_in_one_line(override: str) -> None:
    with pytest.raises(ConfigError) as told:
        gymnasium.make(ENVIRONMENT, overrides=[override])
    assert "\n" not in str(told.value)


def test_what_an_agent_does_to_an_observation_stays_its_own() -> None:
    env = gymnasium.make(ENVIRONMENT).unwrapped
    observation, _ = env.reset(seed=4)
    before = observation["height"].copy()
    observation["height"] -= 1
    with pytest.raises(ValueError, match="is not"):
        env.step(np.array([5, 3, 3]))
    with pytest.raises(ValueError, match="is not"):
        env.step(np.array([0.0, 10.6, 20.2]))
    np.testing.assert_array_equal(env._seen.heightmap.height, before)
    env.close()
    with pytest.raises(ValueError, match="render_mode=banana"):
        gymnasium.make(ENVIRONMENT, render_mode="banana")


def test_it_can_be_made_within_a_program_that_hydra_runs(config: Callable[..., DictConfig]) -> None:
    with initialize_config_module("see2act.conf", version_base="1.3"):
        gymnasium.make(ENVIRONMENT).close()
        assert GlobalHydra.instance().is_initialized()
        assert compose("train").primitive.name == "suction"
