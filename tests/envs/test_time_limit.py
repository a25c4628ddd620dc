"""The last step of an episode, by time limit, goal or contact, and what comes after it."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from env_tools import inner, make
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import ClipAction, TimeLimit
from serial_tools import Emulated, wait_until

from acsar_gym import RobotConfig
from acsar_gym.envs import PointGoalEnv
from acsar_gym.errors import CommandError, ConfigError

pytestmark = pytest.mark.xdist_group(__name__)
ENV_ID = "acsar_gym/PointGoal-v0"
Env = gymnasium.Env[Any, Any]
PLANAR: dict[str, Any] = {"link": "planar"}


def point_goal(**options: Any) -> PointGoalEnv:
    return PointGoalEnv("planar", **options)


def spec_of(env: Env) -> EnvSpec:
    assert env.spec is not None
    return env.spec


LIMITED: dict[str, Callable[[], Env]] = {
    "of the id": lambda: gymnasium.make(ENV_ID, link="planar"),
    "make, shorter": lambda: gymnasium.make(ENV_ID, link="planar", max_episode_steps=5),
    "spec": lambda: gymnasium.make(spec_of(gymnasium.make(ENV_ID, max_episode_steps=5, **PLANAR))),
    "the env's own": lambda: point_goal(max_episode_steps=np.int64(5)),
    "a wrapper": lambda: TimeLimit(ClipAction(point_goal()), 5),
    "the shorter of two": lambda: TimeLimit(point_goal(max_episode_steps=7), 5),
}
STEPS = {
    "of the id": 200,
}


@pytest.mark.parametrize("how", LIMITED)
def test_wheels_stop_with_the_last_step(how: str) -> None:
    env = LIMITED[how]()
    for _ in range(2):
        env.reset(seed=0)
        for step in range(STEPS.get(how, 5)):
            assert any(inner(env).robot.safety.sent) == (step > 0)
            *_, terminated, truncated, _ = env.step(np.array([0.0, 0.5], np.float32))
            assert not terminated
            assert truncated is (step == STEPS.get(how, 5) - 1)
        assert inner(env).robot.safety.sent == (0.0, 0.0)
        for _ in range(2):
            with pytest.raises(ConfigError, match=r"after the end .* reset\(\)"):
                env.step(np.array([1.0, 0.0], np.float32))
            assert inner(env).robot.safety.sent == (0.0, 0.0)
    env.close()


@pytest.mark.parametrize("limit", [None, -1, np.int64(-1)])
def test_no_limit_is_none(limit: Any) -> None:
    env = point_goal(max_episode_steps=limit)
    unwrapped = gymnasium.make(ENV_ID, link="planar", max_episode_steps=-1)
    for endless in (env, unwrapped):
        endless.reset(seed=0)
        ends = [endless.step(np.zeros(2, np.float32))[2:4] for _ in range(210)]
        assert set(ends) == {(False, False)}
        endless.close()


@pytest.mark.parametrize("limit", [0, -2, 2.5, "5", 10**400])
def test_another_limit_is_refused(limit: Any) -> None:
    with pytest.raises(ConfigError, match="max_episode_steps"):
        point_goal(max_episode_steps=limit)


def test_an_env_that_nobody_has_any_more_stops_at_once() -> None:
    """What it knows of its wrappers keeps none of them."""
    env = gymnasium.make(ENV_ID, link="planar")
    env.reset(seed=0)
    gone = weakref.ref(env.unwrapped)
    gc.disable()
    try:
        del env
        assert gone() is None
    finally:
        gc.enable()


class Broken:
    """An action that can't be converted."""

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise self._error


UNREADABLE: dict[str, Any] = {
    "tensor that requires grad": torch.tensor([1.0, 0.0], requires_grad=True),
    "NaN": [np.nan, 0.0],
    "three numbers": [0.5, 0.5, 0.5],
    "None": None,
    "texts": ["0.5", "0.5"],
    "huge": [10**400, 0],
    "raises ValueError": Broken(ValueError("no\nlines")),
}


@pytest.mark.parametrize("action", UNREADABLE)
def test_an_action_that_cannot_be_read_stops_the_wheels(action: str) -> None:
    env = make(ENV_ID)
    env.reset(seed=0)
    env.step([1.0, 0.0])
    with pytest.raises(CommandError, match=r"^action = [^\n]*: must be two finite numbers[^\n]*$"):
        env.step(UNREADABLE[action])
    assert inner(env).robot.safety.sent == (0.0, 0.0)
    env.close()


def test_whatever_else_an_action_raises_stops_the_wheels_too() -> None:
    env = make(ENV_ID)
    env.reset(seed=0)
    env.step([1.0, 0.0])
    with pytest.raises(KeyboardInterrupt):
        env.step(Broken(KeyboardInterrupt()))
    assert inner(env).robot.safety.sent == (0.0, 0.0)
    env.close()


def to_the_limit(env: Env) -> None:
    while not env.step([0.0, 0.5])[3]:
        pass


def to_the_goal(env: Env) -> None:
    while not env.step([1.0, 0.0])[2]:
        pass


def beyond_the_end(env: Env) -> None:
    to_the_goal(env)
    with pytest.raises(ConfigError, match="after the end"):
        env.step([1.0, 0.0])


def with_grad(env: Env) -> None:
    env.step([0.0, 0.5])
    with pytest.raises(CommandError, match="requires grad"):
        env.step(torch.tensor([0.0, 0.5], requires_grad=True))


def not_a_number(env: Env) -> None:
    env.step([0.0, 0.5])
    with pytest.raises(CommandError, match="finite"):
        env.step([np.nan, 0.5])


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize(
    "end", [to_the_limit, to_the_goal, beyond_the_end, with_grad, not_a_number]
)
def test_zeros_are_the_last_word_on_the_wire(
    end: Callable[[Env], None], emulator: Emulated, config: RobotConfig
) -> None:
    """And at once: neither a watchdog nor the board would stop these wheels."""
    endless = config.with_(watchdog_timeout=None)
    env = gymnasium.make(
        ENV_ID,
        link=emulator.device,
        robot=endless,
        max_episode_steps=6 if end is to_the_limit else 100,
        goal_distance=(0.3, 1.0),
    )
    env.reset(seed=0, options={"goal": (0.4, 0.0)})
    end(env)
    wait_until(emulator.is_stopped, "zeros as the last word")
    assert inner(env).robot.active
    env.close()
