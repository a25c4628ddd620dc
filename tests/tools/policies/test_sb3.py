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


def vec_env(num: int = 6, **options: Any) -> BatchVecEnv:
    options = {"max_episode_steps": 20, "goal_distance": (0.3, 0.6), **options}
    return wrapped(PointGoalVectorEnv(num, autoreset_mode="SameStep", **options))


def test_statistics_are_those_of_monitor() -> None:
    """VecMonitor adds rewards up itself; ours must say the same."""
    from stable_baselines3.common.vec_env import VecMonitor

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


def ended(env: BatchVecEnv, steps: int) -> list[dict[str, Any]]:
    """The infos of the episodes that end within some steps of standing still."""
    infos: list[dict[str, Any]] = []
    for _ in range(steps):
        infos += [info for info in env.step(np.zeros((env.num_envs, 2), np.float32))[3] if info]
    return infos


def test_options_hold_until_they_are_set_again() -> None:
    """Also after a reset, which the batch itself takes for the end of its options."""
    ranges = {"friction": (0.4, 0.6), "motor_gain": (0.9, 1.1)}
    batch = ObstacleGoalVectorEnv(
        3,
        autoreset_mode="SameStep",
        max_episode_steps=2,
        worlds="open:1000-1039",
        randomization=ranges,
    )
    env = wrapped(batch)
    env.seed(0)
    env.set_options({"world": 1003})
    env.reset()
    infos = ended(env, 6)
    assert [info["world"] for info in infos] == [1003] * 9
    assert all(0.4 <= info["drawn_friction"] <= 0.6 for info in infos)
    assert all(info["drawn_motor_gain"].shape == (4,) for info in infos)
    env.set_options({"world": [1001, 1002, 1004]})
    assert [info["world"] for info in ended(env, 4)[3:]] == [1001, 1002, 1004]
    env.set_options()
    env.reset()
    assert len({info["world"] for info in ended(env, 6)}) > 3
    env.close()


def test_options_that_cannot_be_are_one_line() -> None:
    env = vec_env(2)
    for options, said in (
        ([{"goal": (1.0, 0.0)}] * 2, "one dict for all robots"),
        ({"reset_mask": [True, False]}, "all robots are reset"),
        ({"goals": 1}, "unknown reset option"),
    ):
        with pytest.raises(ConfigError, match=said):
            env.set_options(options)
    env.reset()
    env.close()


def test_a_batch_is_made_by_its_id() -> None:
    from acsar_gym.tools.policies.sb3 import make_batch

    env = make_batch("point_goal", 3, goal_distance=(0.3, 0.6))
    assert (env.num_envs, env.reset().shape) == (3, (3, 7))
    env.close()
    for env_id, options, said in (("maze", {}, "Maze"), ("point_goal", {"goals": 1}, "goals")):
        with pytest.raises(ConfigError, match=said):
            make_batch(env_id, 2, **options)


def test_other_batches_are_refused() -> None:
    for batch, said in (
        (PointGoalVectorEnv(2), "SameStep"),
        (gymnasium.make_vec("CartPole-v1", 2), "not a batch of acsar_gym"),
    ):
        with pytest.raises(ConfigError, match=said):
            wrapped(batch)
