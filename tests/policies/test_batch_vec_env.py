"""The batch as stable-baselines3 sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from acsar_gym.errors import ConfigError
from acsar_gym.sb3 import BatchVecEnv
from acsar_gym.vectors import PointGoalVectorEnv


def vec_env(num: int = 6, **options: Any) -> BatchVecEnv:
    options = {"max_episode_steps": 20, "goal_distance": (0.3, 0.6), **options}
    return BatchVecEnv(PointGoalVectorEnv(num, autoreset_mode="SameStep", **options))


def test_statistics_are_those_of_monitor() -> None:
    """VecMonitor adds rewards up itself; ours must say the same."""
    ours = vec_env()
    with pytest.warns(UserWarning, match="already wrapped"):
        theirs = VecMonitor(vec_env())
    rng, ended = np.random.default_rng(0), 0
    for env in (ours, theirs):
        env.seed(3)
        env.reset()
    for _ in range(100):
        actions = rng.uniform(-1.0, 1.0, (6, 2)).astype(np.float32)
        (*_, dones, infos), (*_, expected) = ours.step(actions), theirs.step(actions)
        for index in np.flatnonzero(dones):
            episode, monitored = infos[index]["episode"], expected[index]["episode"]
            assert episode["r"] == pytest.approx(monitored["r"], abs=1e-4)
            assert episode["l"] == monitored["l"]
            ended += 1
    ours.close()
    theirs.close()
    assert ended > 20


def test_terminal_observations_are_the_last_of_the_old_episode() -> None:
    env = vec_env()
    env.seed(0)
    env.reset()
    for _ in range(60):
        observations, _, dones, infos = env.step(np.tile(np.array([0.3, 0.8], np.float32), (6, 1)))
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            assert last[5:].tolist() == pytest.approx([0.3, 0.8])
            assert np.asarray(observations)[index][5:].tolist() == [0.0, 0.0]
            late = infos[index]["TimeLimit.truncated"]
            assert late != infos[index]["is_success"] or not late
        assert all(infos[index] == {} for index in np.flatnonzero(~dones))
    env.close()


def test_seeds_repeat_a_rollout() -> None:
    def rollout() -> np.ndarray[Any, Any]:
        env = vec_env()
        env.seed(11)
        seen = [env.reset(), *(env.step(np.ones((6, 2), np.float32))[0] for _ in range(30))]
        env.close()
        return np.array(seen)

    assert (rollout() == rollout()).all()


def test_ppo_learns_on_it_as_it_is() -> None:
    env = vec_env(32)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=256, device="cpu", seed=0)
    model.learn(1024)
    assert len(model.ep_info_buffer or []) > 0
    assert len(model.ep_success_buffer or []) > 0
    env.close()


def test_other_autoreset_modes_are_refused() -> None:
    with pytest.raises(ConfigError, match="SameStep"):
        BatchVecEnv(PointGoalVectorEnv(2))


def test_robots_have_nothing_of_their_own() -> None:
    env = vec_env(2)
    assert env.get_attr("render_mode") == [None, None]
    for call in (lambda: env.env_method("step"), lambda: env.set_attr("x", 1)):
        with pytest.raises(ConfigError, match="robots of a batch"):
            call()
    env.close()
