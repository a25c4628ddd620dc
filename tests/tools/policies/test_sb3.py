"""The batch as stable-baselines3 sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.errors import ConfigError

if TYPE_CHECKING:
    from acsar_gym.tools.policies.sb3 import BatchVecEnv


pytestmark = pytest.mark.xdist_group(__name__)


def wrapped(batch: Any) -> BatchVecEnv:
    """SB3 and torch are imported by the tests that need them."""
    from acsar_gym.tools.policies.sb3 import BatchVecEnv

    return BatchVecEnv(batch)


def make_env(num: int = 6, **options: Any) -> BatchVecEnv:
    options = {"max_episode_steps": 20, "goal_distance": (0.3, 0.6), **options}
    return wrapped(PointGoalVectorEnv(num, autoreset_mode="SameStep", **options))


def test_batch_vec_env_reports_the_statistics_of_monitor_and_terminal_observations() -> None:
    """VecMonitor adds rewards up itself. The sums must be the same."""
    from stable_baselines3.common.vec_env import VecMonitor

    ours = make_env()
    with pytest.warns(UserWarning, match="already wrapped"):
        theirs = VecMonitor(make_env())
    rng = np.random.default_rng(0)
    episodes = 0
    for env in (ours, theirs):
        env.seed(3)
        env.reset()
    for _ in range(100):
        actions = rng.uniform(-1.0, 1.0, (6, 2)).astype(np.float32)
        observations, _, dones, infos = ours.step(actions)
        *_, expected = theirs.step(actions)
        assert all(infos[index] == {} for index in np.flatnonzero(~dones))
        for index in np.flatnonzero(dones):
            episode = infos[index]["episode"]
            monitored = expected[index]["episode"]
            assert episode["r"] == pytest.approx(monitored["r"], abs=1e-4)
            assert episode["l"] == monitored["l"]
            # The last two numbers are the last action, which a new episode doesn't have.
            last = infos[index]["terminal_observation"]
            assert last[5:] == pytest.approx(actions[index])
            assert np.asarray(observations)[index][5:].tolist() == [0.0, 0.0]
            assert infos[index]["TimeLimit.truncated"] != infos[index]["is_success"]
            episodes += 1
    ours.close()
    theirs.close()
    assert episodes > 20


def test_set_options_holds_until_it_is_called_again() -> None:
    """Also after a reset, and without one for the episodes that start next, as in a curriculum."""
    batch = ObstacleGoalVectorEnv(
        3,
        autoreset_mode="SameStep",
        max_episode_steps=2,
        worlds="open:1000-1039",
        randomization={"friction": (0.4, 0.6), "motor_gain": (0.9, 1.1)},
    )
    env = wrapped(batch)

    def worlds(steps: int) -> list[int]:
        ends = [
            info for _ in range(steps) for info in env.step(np.zeros((3, 2), np.float32))[3] if info
        ]
        assert all(0.4 <= end["drawn_friction"] <= 0.6 for end in ends)
        assert all(end["drawn_motor_gain"].shape == (4,) for end in ends)
        return [end["world"] for end in ends]

    env.seed(0)
    env.set_options({"world": 1003})
    for _ in range(2):
        env.reset()
        assert worlds(4) == [1003] * 6
    env.set_options({"world": [1001, 1002, 1004]})
    assert worlds(4)[3:] == [1001, 1002, 1004]
    env.set_options()
    env.reset()
    assert len(set(worlds(6))) > 3
    env.close()


def test_batch_vec_env_refuses_other_batches_and_options() -> None:
    from acsar_gym.tools.policies.sb3 import make_batch

    with pytest.raises(ConfigError, match="goals"):
        make_batch("point_goal", 2, goals=1)
    env = make_batch("point_goal", 2, goal_distance=(0.3, 0.6))
    assert env.reset().shape == (2, 7)
    for options, message in (
        ([{"world": 1}, {"world": 2}], "one dict for all robots"),
        ({"reset_mask": [True, False]}, "all robots are reset"),
        ({"goals": 1}, "goals"),
    ):
        with pytest.raises(ConfigError, match=message):
            env.set_options(options)
    env.reset()
    env.close()
    for batch, message in (
        (PointGoalVectorEnv(2), "SameStep"),
        (gymnasium.make_vec("CartPole-v1", 2), "not a batch of acsar_gym"),
    ):
        with pytest.raises(ConfigError, match=message):
            wrapped(batch)
