"""The environment: Gymnasium's rules, determinism, and errors that stop the wheels."""

from __future__ import annotations

import copy
import hashlib
import math
import subprocess
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from acsar_gym import open_link
from acsar_gym.config import RobotConfig
from acsar_gym.envs import PointGoalEnv
from acsar_gym.errors import CommandError, ConfigError, RenderError

ENV_ID = "acsar_gym/PointGoal-v0"
LINKS = ["bullet", "planar"]
ROLLOUT = """
import hashlib, gymnasium, numpy as np
env = gymnasium.make("acsar_gym:acsar_gym/PointGoal-v0", link="{link}")
digest = hashlib.sha256()
rng = np.random.default_rng(5)
for seed in (7, None, None):
    observation, info = env.reset(seed=seed)
    digest.update(observation.tobytes())
    for _ in range(100):
        step = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
        digest.update(step[0].tobytes() + repr(step[1:]).encode())
        if step[2]:
            break
print(digest.hexdigest())
"""


def make(link: Any = "planar", **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(ENV_ID, link=link, **options)


@pytest.fixture(params=LINKS)
def env(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    made = make(request.param)
    yield made
    made.close()


def inner(env: gymnasium.Env[Any, Any]) -> PointGoalEnv:
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, PointGoalEnv)
    return unwrapped


@pytest.mark.parametrize("link", LINKS)
def test_gymnasium_finds_nothing_to_complain_about(link: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(link)
        check_env(env.unwrapped, skip_render_check=True)
        env.close()


@pytest.mark.parametrize("link", LINKS)
def test_stable_baselines3_finds_nothing_to_complain_about(link: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(link)
        sb3_check_env(env.unwrapped)
        env.close()


@pytest.mark.parametrize("link", LINKS)
def test_two_processes_with_one_seed_see_the_same_bits(link: str) -> None:
    code = ROLLOUT.format(link=link)
    digests = [
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
        ).stdout
        for _ in range(2)
    ]
    assert digests[0] == digests[1]
    assert len(digests[0].strip()) == 64


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


def test_driving_away_ends_out_of_bounds() -> None:
    env = make(robot=RobotConfig(max_linear=1.2))
    env.reset(options={"goal": (-1.0, 0.0)})
    terminated = False
    while not terminated:
        _, reward, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
    env.close()
    assert float(reward) < -2.0
    assert info["is_success"] == 0.0


def test_the_time_limit_truncates() -> None:
    env = make()
    env.reset(seed=0)
    for k in range(200):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        assert terminated is False
        assert truncated is (k == 199)
    env.close()


def test_info_holds_the_same_floats_at_every_step(env: gymnasium.Env[Any, Any]) -> None:
    _, first = env.reset(seed=1)
    for _ in range(5):
        *_, info = env.step(env.action_space.sample())
        assert info.keys() == first.keys()
        assert all(type(value) is float for value in info.values())
        assert not any(math.isnan(value) for value in info.values())


def test_a_constructor_opens_nothing() -> None:
    make("/dev/there-is-no-such-port").close()


@pytest.mark.parametrize("action", [[np.nan, 0.0], [np.inf, 0.0], [0.0], [0.0, 0.0, 0.0], "ab"])
def test_bad_actions_stop_the_wheels(action: Any) -> None:
    env = inner(make())
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.array([1.0, 0.0], np.float32))
    with pytest.raises(CommandError, match="two finite numbers"):
        env.step(action if isinstance(action, str) else np.array(action, np.float32))  # type: ignore[arg-type]
    env.robot.link.advance(1.0)
    assert env.robot.link.truth is not None
    assert env.robot.link.truth.twist == pytest.approx((0.0, 0.0), abs=1e-6)
    env.reset()
    env.close()


def test_actions_beyond_the_box_are_clipped() -> None:
    env = inner(make())
    env.reset(seed=0)
    observation, *_ = env.step(np.array([7.0, -7.0], np.float32))
    assert observation[5:].tolist() == [1.0, -1.0]
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"link": "bulet"}, "did you mean 'bullet'"),
        ({"robot": "acsra"}, "did you mean 'acsar'"),
        ({"policy_rate": 30.0}, "whole multiple of policy_rate"),
        ({"goal_distance": (2.0, 1.0)}, "nearest <= farthest"),
        ({"goal_tolerance": 0.0}, "tolerance"),
    ],
)
def test_bad_options_are_one_clear_error(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**options)


@pytest.mark.parametrize("goal", [(9.0, 9.0), (0.0, 0.0), "x"])
def test_bad_goals_are_one_clear_error(goal: Any) -> None:
    env = make()
    with pytest.raises(ConfigError, match="goal"):
        env.reset(options={"goal": goal})
    env.close()


@pytest.mark.parametrize(
    ("link", "view", "shape"),
    [
        ("bullet", "top", (480, 480, 3)),
        ("planar", "top", (480, 480, 3)),
        ("bullet", "camera", (480, 640, 3)),
    ],
)
def test_pictures_are_pictures(link: str, view: str, shape: tuple[int, int, int]) -> None:
    env = make(link, render_mode="rgb_array", view=view)
    env.reset(seed=0)
    before: Any = env.render()
    for _ in range(10):
        env.step(np.array([1.0, 1.0], np.float32))
    after: Any = env.render()
    env.close()
    assert before.shape == after.shape == shape
    assert after.dtype == np.uint8
    assert (before != after).any()


@pytest.mark.parametrize("link", ["planar", "/dev/ttyUSB0"])
def test_links_without_a_camera_say_so(link: str) -> None:
    with pytest.raises(RenderError, match="bullet"):
        make(link, render_mode="rgb_array", view="camera")


def test_closing_twice_is_silent() -> None:
    env = inner(make())
    env.reset(seed=0)
    env.close()
    env.close()


def test_two_environments_do_not_disturb_each_other() -> None:
    alone = make("bullet")
    expected = observations(alone, 9)
    alone.close()
    one, two = make("bullet"), make("bullet")
    one.reset(seed=9)
    two.reset(seed=1)
    two.step(np.array([1.0, 1.0], np.float32))
    assert observations(one, 9) == expected
    one.close()
    two.close()


def test_a_reset_stops_the_wheels_before_anything_can_go_wrong() -> None:
    env = inner(make())
    env.reset(seed=0)
    env.step(np.array([1.0, 0.0], np.float32))
    with pytest.raises(ConfigError):
        env.reset(options={"goal": (99.0, 0.0)})
    env.robot.link.advance(1.0)
    assert env.robot.link.truth is not None
    assert env.robot.link.truth.twist == pytest.approx((0.0, 0.0), abs=1e-6)
    env.close()


@pytest.mark.parametrize(
    "options",
    [
        {"policy_rate": 0},
        {"policy_rate": math.nan},
        {"policy_rate": "10"},
        {"goal_distance": 3},
        {"goal_distance": ("a", 2)},
        {"goal_tolerance": None},
        {"link": None},
        {"link": 5},
        {"robot": 5},
    ],
)
def test_arguments_of_the_wrong_kind_are_config_errors(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        make(**options)


def test_unknown_reset_options_are_refused() -> None:
    env = make()
    with pytest.raises(ConfigError, match="did you mean 'goal'"):
        env.reset(options={"gaol": (1.0, 0.0)})
    env.close()


def test_there_is_no_picture_before_the_reset() -> None:
    env = inner(make("bullet", render_mode="rgb_array"))
    with pytest.raises(RenderError, match="reset"):
        env.render()
    env.close()


def test_copies_of_a_spec_share_no_simulation() -> None:
    link = open_link("bullet")
    env = make(link)
    env.reset(seed=0)
    copied = copy.deepcopy(link)
    copied.open()
    copied.close()
    env.step(np.zeros(2, np.float32))
    env.close()
