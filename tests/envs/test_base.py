"""The environment: Gymnasium's rules, determinism, and errors that stop the wheels."""

from __future__ import annotations

import copy
import hashlib
import math
import pickle
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.envs import PointGoalEnv
from acsar_gym.errors import ConfigError, MissingExtraError

ENV_ID = "acsar_gym/PointGoal-v0"


def make(link: Any = "planar", **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(ENV_ID, link=link, **options)


@pytest.fixture(params=["bullet", "planar"])
def env(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    made = make(request.param)
    yield made
    made.close()


def inner(env: gymnasium.Env[Any, Any]) -> PointGoalEnv:
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, PointGoalEnv)
    return unwrapped


def observations(env: gymnasium.Env[Any, Any], seed: int) -> str:
    digest = hashlib.sha256(env.reset(seed=seed)[0].tobytes())
    for k in range(60):
        digest.update(env.step(np.array([0.5, math.sin(k)], np.float32))[0].tobytes())
    return digest.hexdigest()


def test_what_went_before_leaves_no_trace(env: gymnasium.Env[Any, Any]) -> None:
    first = observations(env, 3)
    observations(env, 4)
    assert observations(env, 3) == first


def test_driving_at_the_goal_ends_in_success(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0, options={"goal": (1.0, 0.0)})
    total, steps, terminated, truncated = 0.0, 0, False, False
    info: dict[str, Any] = {}
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        total += float(reward)
        steps += 1
    assert terminated is True
    assert truncated is False
    assert info["is_success"] == 1.0
    assert info["goal_distance"] <= 0.15
    assert info["odometry_error"] < 0.02
    assert total == pytest.approx(2.0 * (1.0 - info["goal_distance"]) - 0.02 * steps + 2.0)


def test_a_reset_that_is_refused_stops_the_wheels() -> None:
    env = inner(make())
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.array([1.0, 0.0], np.float32))
    with pytest.raises(ConfigError):
        env.reset(options={"goal": (99.0, 0.0)})
    env.robot.link.advance(1.0)
    assert env.robot.link.truth is not None
    assert env.robot.link.truth.twist == pytest.approx((0.0, 0.0), abs=1e-6)
    env.reset()
    env.close()


COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),  # noqa: S301 - our own bytes
}


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_in_mid_episode_must_be_reset_first(how: str, env: gymnasium.Env[Any, Any]) -> None:
    live = inner(env)
    live.reset(seed=3)
    live.step(np.array([1.0, 0.0], np.float32))
    before = live.robot.odometry.pose
    copied = COPIES[how](live)
    assert copied.robot is not live.robot
    assert copied.robot.link is not live.robot.link
    with pytest.raises(ConfigError, match=r"step\(\) before reset\(\)"):
        copied.step(np.zeros(2, np.float32))
    with pytest.raises(ConfigError, match=r"before reset\(\)"):
        _ = copied.episode
    copied.close()
    assert (live.robot.active, live.robot.odometry.pose) == (True, before)
    copied.reset(seed=7)
    seen = copied.step(np.array([0.5, 0.1], np.float32))[0]
    live.reset(seed=7)
    assert (live.step(np.array([0.5, 0.1], np.float32))[0] == seen).all()
    copied.close()


MISSING: list[tuple[str, dict[str, Any], str]] = [
    ("pybullet", {}, "bullet"),  # the default link
    ("mujoco", {"link": "mujoco"}, "mujoco"),
    ("mcap", {"link": "planar", "record": "drive.mcap"}, "record"),
    ("PIL", {"link": "planar", "render_mode": "rgb_array"}, "pictures"),
]


@pytest.mark.parametrize(("module", "options", "extra"), MISSING)
def test_an_env_without_its_extra_is_one_line_when_it_is_made(
    module: str, options: dict[str, Any], extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    said = rf"^[^\n]* needs an extra: pip install 'acsar_gym\[{extra}\]'$"
    with pytest.raises(MissingExtraError, match=said):
        gymnasium.make(ENV_ID, **options)


def test_a_life_from_construction_to_the_end() -> None:
    """Nothing is opened before a reset; actions are clipped; closing twice is once."""
    make("/dev/there-is-no-such-port").close()
    env = inner(make(render_mode="rgb_array"))
    with pytest.raises(ConfigError, match=r"step\(\) before reset\(\)"):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(ConfigError, match="reset"):
        env.render()
    for options, named in (({"goal": (9.0, 9.0)}, "goal"), ({"gaol": (1.0, 0.0)}, "'goal'")):
        with pytest.raises(ConfigError, match=named):
            env.reset(options=options)
    env.reset(seed=0)
    assert env.step(np.array([7.0, -7.0], np.float32))[0][5:].tolist() == [1.0, -1.0]
    env.close()
    env.close()
