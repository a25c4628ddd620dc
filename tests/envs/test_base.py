"""The environment: Gymnasium's rules, determinism, and errors that stop the wheels."""

from __future__ import annotations

import copy
import pickle
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from scenes import HALL

from acsar_gym.errors import ConfigError, MissingExtraError

POINT_GOAL = "acsar_gym/PointGoal-v0"
OBSTACLE_GOAL = "acsar_gym/ObstacleGoal-v1"
AHEAD = np.array([1.0, 0.0], np.float32)
ARC = np.array([0.5, 0.1], np.float32)


def test_step_to_the_goal_ends_in_success(link: str, make: Any) -> None:
    env = make(link=link)
    env.reset(seed=0, options={"goal": (1.0, 0.0)})
    rewards = []
    terminated = truncated = False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(AHEAD)
        rewards.append(float(reward))

    assert (terminated, truncated, info["is_success"]) == (True, False, 1.0)
    assert info["goal_distance"] <= 0.15
    assert info["odometry_error"] < 0.02
    total = 2.0 * (1.0 - info["goal_distance"]) - 0.02 * len(rewards) + 2.0
    assert sum(rewards) == pytest.approx(total)


def test_reset_that_is_refused_stops_the_wheels(make: Any) -> None:
    env = make().unwrapped
    env.reset(seed=0)
    for _ in range(10):
        env.step(AHEAD)
    with pytest.raises(ConfigError):
        env.reset(options={"goal": (99.0, 0.0)})
    env.robot.link.advance(1.0)
    assert env.robot.link.truth is not None
    assert env.robot.link.truth.twist == pytest.approx((0.0, 0.0), abs=1e-6)
    env.reset()


def unpickle(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))  # noqa: S301 - our own bytes


@pytest.mark.parametrize(
    ("copy_env", "link", "options"),
    [(copy.deepcopy, "bullet", {}), (unpickle, "planar", {"worlds": HALL})],
)
def test_copy_in_mid_episode_is_an_env_of_its_own(
    copy_env: Any, link: str, options: dict[str, Any], make: Any
) -> None:
    env = make(OBSTACLE_GOAL, link, **options).unwrapped
    env.reset(seed=3)
    env.step(AHEAD)
    pose = env.robot.odometry.pose
    copied = copy_env(env)
    with pytest.raises(ConfigError, match=r"step\(\) before reset\(\)"):
        copied.step(ARC)
    with pytest.raises(ConfigError, match=r"before reset\(\)"):
        _ = copied.episode
    copied.close()
    assert (env.robot.active, env.robot.odometry.pose) == (True, pose)

    episodes = [repr([e.reset(seed=7), e.step(ARC), e.step(ARC)]) for e in (env, copied)]
    copied.close()
    assert episodes[0] == episodes[1]


@pytest.mark.parametrize(
    ("module", "options", "extra"),
    [("pybullet", {}, "bullet"), ("mcap", {"link": "planar", "record": "drive.mcap"}, "record")],
)
def test_make_without_its_extra_is_one_line(
    module: str, options: dict[str, Any], extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    message = rf"^[^\n]* needs an extra, .* '\.\[{extra}\]'$"
    with pytest.raises(MissingExtraError, match=message):
        gymnasium.make(POINT_GOAL, **options)


def test_env_life_from_construction_to_the_end(make: Any) -> None:
    """Nothing is opened before a reset, actions are clipped, and closing twice is once."""
    make(link="/dev/there-is-no-such-port").close()
    env = make(render_mode="rgb_array").unwrapped
    with pytest.raises(ConfigError, match=r"step\(\) before reset\(\)"):
        env.step(AHEAD)
    with pytest.raises(ConfigError, match="reset"):
        env.render()
    for options in ({"goal": (9.0, 9.0)}, {"gaol": (1.0, 0.0)}):
        with pytest.raises(ConfigError, match="goal"):
            env.reset(options=options)
    env.reset(seed=0)
    assert env.step(np.array([7.0, -7.0], np.float32))[0][5:].tolist() == [1.0, -1.0]
    env.close()
    env.close()
