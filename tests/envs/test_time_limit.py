"""The last step of an episode, by time limit, goal or contact, and what comes after it."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, TimeLimit
from serial_tools import Emulated, wait_until

from acsar_gym import RobotConfig, RobotEnv
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.tasks import PointGoal

pytestmark = pytest.mark.xdist_group(__name__)
Env = Any
POINT_GOAL = "acsar_gym/PointGoal-v0"


def point_goal(**options: Any) -> RobotEnv:
    return RobotEnv(PointGoal, "planar", **options)


def make_planar(**options: Any) -> Env:
    return gymnasium.make(POINT_GOAL, link="planar", **options)


@pytest.mark.parametrize(
    ("make_env", "limit"),
    [
        (make_planar, 200),
        (lambda: point_goal(max_episode_steps=np.int64(5)), 5),
        (lambda: TimeLimit(ClipAction(point_goal(max_episode_steps=7)), 5), 5),
    ],
)
def test_time_limit_stops_the_wheels_with_the_last_step(
    make_env: Callable[[], Env], limit: int
) -> None:
    env = make_env()
    for _ in range(2):
        env.reset(seed=0)
        for step in range(limit):
            assert any(env.unwrapped.robot.safety.sent) == (step > 0)
            *_, terminated, truncated, _ = env.step(np.array([0.0, 0.5], np.float32))
            assert (terminated, truncated) == (False, step == limit - 1)
        assert env.unwrapped.robot.safety.sent == (0.0, 0.0)
        for _ in range(2):
            with pytest.raises(ConfigError, match=r"after the end .* reset\(\)"):
                env.step(np.array([1.0, 0.0], np.float32))
            assert env.unwrapped.robot.safety.sent == (0.0, 0.0)
    env.close()


def test_time_limit_may_be_none() -> None:
    for env in (point_goal(max_episode_steps=None), make_planar(max_episode_steps=-1)):
        env.reset(seed=0)
        ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(210)]
        assert set(ends) == {(False, False)}
        env.close()


@pytest.mark.parametrize("limit", [0, "5"])
def test_time_limit_that_is_wrong_is_refused(limit: Any) -> None:
    with pytest.raises(ConfigError, match="max_episode_steps"):
        point_goal(max_episode_steps=limit)


def test_env_without_references_stops_at_once() -> None:
    """It keeps no reference to its wrappers."""
    env = make_planar()
    env.reset(seed=0)
    inside = weakref.ref(env.unwrapped)
    gc.disable()
    try:
        del env
        assert inside() is None
    finally:
        gc.enable()


class Broken:
    """An action at which Ctrl-C comes."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt


REFUSED = "^action = .*: must be two finite numbers"


@pytest.mark.parametrize(
    ("action", "message"),
    [([np.nan, 0.0], REFUSED), ([0.5] * 3, REFUSED), (["a", "0.5"], REFUSED), (Broken(), "^$")],
)
def test_action_that_cannot_be_read_stops_the_wheels(action: Any, message: str, make: Any) -> None:
    env = make()
    env.reset(seed=0)
    env.step([1.0, 0.0])
    with pytest.raises((CommandError, KeyboardInterrupt), match=message):
        env.step(action)
    assert env.unwrapped.robot.safety.sent == (0.0, 0.0)


def to_the_limit(env: Env) -> None:
    while not env.step([0.0, 0.5])[3]:
        pass


def beyond_the_end(env: Env) -> None:
    while not env.step([1.0, 0.0])[2]:
        pass
    with pytest.raises(ConfigError, match="after the end"):
        env.step([1.0, 0.0])


def not_a_number(env: Env) -> None:
    env.step([0.0, 0.5])
    with pytest.raises(CommandError, match="finite"):
        env.step([np.nan, 0.5])


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize("end", [to_the_limit, beyond_the_end, not_a_number])
def test_step_at_the_end_sends_zero(
    end: Callable[[Env], None], emulator: Emulated, config: RobotConfig, make: Any
) -> None:
    """And at once: neither a watchdog nor the board would stop these wheels."""
    env = make(
        link=emulator.device,
        robot=config.with_(watchdog_timeout=None),
        max_episode_steps=6 if end is to_the_limit else 100,
        goal_distance=(0.3, 1.0),
    )
    env.reset(seed=0, options={"goal": (0.4, 0.0)})
    end(env)
    wait_until(emulator.is_stopped, "zeros as the last command")
    assert env.unwrapped.robot.active
