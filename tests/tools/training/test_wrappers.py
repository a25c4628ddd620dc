"""Rewards for coming nearer along the way around obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.policies import sb3
from acsar_gym.tools.policies.sb3 import BatchVecEnv
from acsar_gym.tools.training import wrappers
from acsar_gym.tools.training.wrappers import Detours, detours, find_robots
from acsar_gym.vector import env
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds.search import GoalDistances, measure_goal_distances
from acsar_gym.worlds.world import World

ROBOTS, WORLDS = 4, "clutter:1000-1002"


def batch() -> BatchVecEnv:
    """A few robots among obstacles."""
    made = sb3.make_batch("obstacle_goal", ROBOTS, worlds=WORLDS, threads=1)
    made.seed(3)
    return made


def robots_in(shaped: Detours) -> RobotVectorEnv:
    """The batch behind the wrapper."""
    robots = find_robots(shaped)
    assert robots is not None
    return robots


def test_rewards_differ_by_the_detour_put_behind() -> None:
    plain, shaped = batch(), Detours(batch(), weight=3.0)
    assert_allclose(plain.reset(), np.asarray(shaped.reset()))
    before = shaped.detours()
    assert (before > 0.0).any()
    for step in range(30):
        actions = np.full((ROBOTS, 2), [1.0, 0.3], np.float32)
        _, rewards, dones, _ = plain.step(actions)
        _, other, _, _ = shaped.step(actions)
        after = shaped.detours()
        gained = np.where(dones, 0.0, 3.0 * (before - after))
        assert_allclose(other, rewards + gained, atol=1e-5, err_msg=f"step {step}")
        before = after


def test_the_way_at_first_is_about_the_shortest_path_of_the_robots_own_world() -> None:
    shaped = Detours(batch())
    shaped.reset()
    robots = robots_in(shaped)
    assert robots.pool is not None
    worlds = [robots.pool[int(number)] for number in robots.batch.info()["world"]]
    straight = [np.hypot(one.goal.x - one.start.x, one.goal.y - one.start.y) for one in worlds]
    ways = (shaped.detours() + straight) / [one.length for one in worlds]
    assert ((ways > 0.95) & (ways < 1.5)).all()


def test_places_are_those_where_the_robots_really_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without ways, what is left is the straight line from there."""

    def none(worlds: Sequence[World], config: RobotConfig) -> GoalDistances:
        found = measure_goal_distances(worlds, config)
        return found._replace(values=np.zeros_like(found.values))

    monkeypatch.setattr(wrappers, "measure_goal_distances", none)
    shaped = Detours(batch())
    shaped.reset()
    for _ in range(15):
        shaped.step(np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0], [-1.0, 0.5]], np.float32))
        far = robots_in(shaped).batch.info()["true_goal_distance"]
        assert_allclose(-shaped.detours(), far, atol=1e-6)


def test_nothing_is_remembered_between_steps() -> None:
    shaped = Detours(batch())
    shaped.reset()
    actions = np.full((ROBOTS, 2), [0.8, -0.2], np.float32)
    shaped.step(actions)
    robots = robots_in(shaped)
    kept = {name: array.copy() for name, array in (env.copy_state(robots) or {}).items()}
    rewards = shaped.step(actions)[1]
    other = Detours(batch())
    other.reset()
    env.restore_state(robots_in(other), kept)
    assert_allclose(other.step(actions)[1], rewards)


def test_wrappers_are_looked_through_and_single_envs_stay() -> None:
    assert isinstance(detours(VecCheckNan(batch())), Detours)
    single = DummyVecEnv([lambda: gymnasium.make("CartPole-v1")])
    assert detours(single) is single
    single.close()


def test_a_batch_without_worlds_is_refused() -> None:
    with pytest.raises(ConfigError, match="robots in worlds"):
        Detours(sb3.make_batch("point_goal", 2))
