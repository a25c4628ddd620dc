"""What recipes name as `vec_env_wrapper`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv

import acsar_gym  # noqa: F401 - registers the ids
from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tasks import ObstacleGoal
from acsar_gym.tools.policies import sb3
from acsar_gym.tools.training.wrappers import without_rays

ROBOTS = 3
OPTIONS: Mapping[str, Any] = {"worlds": "clutter:1000-1002", "max_episode_steps": 12}
KEPT = len(ObstacleGoal.observation) + len(MAP_NAMES)


def batch(**options: Any) -> VecEnv:
    return sb3.make_batch("obstacle_goal", ROBOTS, threads=1, **{**OPTIONS, **options})


def singles(**options: Any) -> VecEnv:
    def make() -> Any:
        asked = {"link": "planar", **OPTIONS, **options}
        return gymnasium.make("acsar_gym/ObstacleGoal-v1", **asked)

    return DummyVecEnv([make] * ROBOTS)


KINDS: Mapping[str, Callable[..., VecEnv]] = {
    "a batch": batch,
    "a batch in a wrapper": lambda **options: VecCheckNan(batch(**options)),
    "single envs": singles,
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_numbers_are_those_of_the_whole_observation(kind: str) -> None:
    whole, short = KINDS[kind](), without_rays(KINDS[kind]())
    space: Any = short.observation_space
    full: Any = whole.observation_space
    assert_array_equal(space.low, full.low[:KEPT])
    assert_array_equal(space.high, full.high[:KEPT])
    for env in (whole, short):
        env.seed(3)
    seen, first = whole.reset(), short.reset()
    ended = 0
    for _ in range(30):
        assert_array_equal(first, np.asarray(seen)[:, :KEPT])
        actions = np.full((ROBOTS, 2), [0.6, 0.3], np.float32)
        seen, rewards, dones, infos = whole.step(actions)
        first, same, over, told = short.step(actions)
        assert_array_equal(same, rewards)
        assert_array_equal(over, dones)
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            assert_array_equal(told[index]["terminal_observation"], last[:KEPT])
        ended += int(dones.sum())
    assert ended >= ROBOTS
    whole.close()
    short.close()


def test_robots_with_another_lidar_give_as_many_numbers() -> None:
    env = without_rays(batch(robot=RobotConfig().with_(lidar={"rays": 90})))
    assert env.observation_space.shape == (KEPT,)
    env.close()


def test_robots_without_a_map_are_refused() -> None:
    env = sb3.make_batch("point_goal", 2)
    with pytest.raises(ConfigError, match="robots with a map and a LiDAR"):
        without_rays(env)
    env.close()
