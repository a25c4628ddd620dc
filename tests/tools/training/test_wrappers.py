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
        arguments = {"link": "planar", **OPTIONS, **options}
        return gymnasium.make("acsar_gym/ObstacleGoal-v1", **arguments)

    return DummyVecEnv([make] * ROBOTS)


KINDS: Mapping[str, Callable[..., VecEnv]] = {
    "a batch in a wrapper": lambda **options: VecCheckNan(batch(**options)),
    "single envs": singles,
}


@pytest.mark.parametrize("kind", KINDS)
def test_without_rays_keeps_the_first_numbers(kind: str) -> None:
    full_env = KINDS[kind]()
    short = without_rays(KINDS[kind]())
    space: Any = short.observation_space
    full: Any = full_env.observation_space
    assert_array_equal(space.low, full.low[:KEPT])
    assert_array_equal(space.high, full.high[:KEPT])

    for env in (full_env, short):
        env.seed(3)
    assert_array_equal(short.reset(), np.asarray(full_env.reset())[:, :KEPT])
    episodes = 0
    actions = np.full((ROBOTS, 2), [0.6, 0.3], np.float32)
    for _ in range(30):
        observations, rewards, dones, infos = full_env.step(actions)
        short_observations, *unchanged, short_infos = short.step(actions)
        assert_array_equal(short_observations, np.asarray(observations)[:, :KEPT])
        assert_array_equal(unchanged, [rewards, dones])
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            assert_array_equal(short_infos[index]["terminal_observation"], last[:KEPT])
        episodes += int(dones.sum())
    assert episodes >= ROBOTS
    full_env.close()
    short.close()


def test_without_rays_needs_a_map_and_leaves_out_any_lidar() -> None:
    env = without_rays(batch(robot=RobotConfig().with_(lidar={"rays": 90})))
    assert env.observation_space.shape == (KEPT,)
    env.close()
    env = sb3.make_batch("point_goal", 2)
    with pytest.raises(ConfigError, match="robots with a map and a LiDAR"):
        without_rays(env)
    env.close()
