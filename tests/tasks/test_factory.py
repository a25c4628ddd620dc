"""Mistakes in a user's class of tasks: one line that names the user's own file and line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

import acsar_gym
from acsar_gym import Outcome, RobotEnv, State, Task
from acsar_gym.errors import AcsarWarning, ConfigError
from acsar_gym.vector.env import RobotVectorEnv

register: Any = acsar_gym.register
KINDS: list[Any] = [RobotEnv, RobotVectorEnv]


class Plain(Task):
    """A sound task, whose methods the tests replace."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"x": (-50.0, 50.0)}
    tolerance: float = 0.15
    bare = 3

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return 0.0

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return (state.pose[0],)


def make(kind: Any, task: Any, **options: Any) -> Any:
    return kind(task, **({"link": "planar"} | options))


def place_of(function: Any) -> str:
    """The user's file and line, as messages have them."""
    code = function.__code__
    return re.escape(f"({code.co_filename}:{code.co_firstlineno})")


OUTCOMES: dict[str, Any] = {
    "True": lambda *_: True,
    "a name": lambda *_: "SUCCESS",
    "None": lambda *_: None,
    "a number of none": lambda *_: 7,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", OUTCOMES)
def test_what_is_no_outcome_is_named(kind: Any, name: str) -> None:
    task = type("Mine", (Plain,), {"outcome": OUTCOMES[name]})
    said = rf"^Mine.outcome returned .*: must be an Outcome.* {place_of(OUTCOMES[name])}"
    with pytest.raises(ConfigError, match=said):
        make(kind, task)


SIGNATURES: list[tuple[str, Any]] = [
    ("reward", lambda self, state: 0.0),
    ("reward", lambda self, state, memory, outcome, more: 0.0),
    ("begin", lambda self, state: None),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("method", "function"), SIGNATURES)
def test_a_method_with_another_signature_is_named(kind: Any, method: str, function: Any) -> None:
    task = type("Mine", (Plain,), {method: function})
    said = rf"^Mine: must have {method}\(state, memory.*\), .*: .* {place_of(function)}$"
    with pytest.raises(ConfigError, match=said):
        make(kind, task)


def text(*_: Any) -> Any:
    return "much"


def two(*_: Any) -> Any:
    return 1.0, 2.0


@pytest.mark.parametrize(
    ("method", "function", "said"),
    [
        ("reward", text, "reward returned 'much': must be a number"),
        ("observe", two, r"observe returned numbers of shape \(2,\): must be 1"),
        ("observe", lambda *_: ((1.0,), 2.0), r"observe returned \(\(1.0,\), 2.0\): must be 1"),
    ],
)
def test_what_a_method_returns_is_named_with_its_line(
    method: str, function: Any, said: str
) -> None:
    with pytest.raises(ConfigError, match=rf"^Mine\.{said}.* {place_of(function)}$"):
        make(RobotEnv, type("Mine", (Plain,), {method: function}))


@dataclass(frozen=True)
class WithField(Plain):
    """With an option."""

    tolerance: float = 0.15


@pytest.mark.parametrize(
    ("option", "hint"),
    [
        ("max_steps", "max_episode_steps"),
        ("tolerence", "tolerance"),
        ("max_episode_step", "max_episode_steps"),
    ],
)
def test_an_option_that_nothing_has_is_not_registered(option: str, hint: str) -> None:
    said = f"mine/Typo-v0: unknown option '{option}'; did you mean '{hint}'"
    with pytest.raises(ConfigError, match=said):
        register("mine/Typo-v0", task=WithField, **{option: 5})
    assert "mine/Typo-v0" not in gymnasium.registry


class Beyond(Plain):
    """Observes more than it has declared."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        "ahead": (-50.0, 50.0),
        "steps": (0.0, 0.15),
    }

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return state.pose[0], state.time


@pytest.mark.parametrize(
    ("kind", "compiled"),
    [
        (RobotEnv, False),
        (RobotVectorEnv, False),
        pytest.param(RobotVectorEnv, True, marks=pytest.mark.slow),
    ],
)
def test_an_observation_beyond_its_bounds_is_said_once(kind: Any, compiled: bool) -> None:
    env = make(kind, type("Mine", (Beyond,), {"compiled": compiled}))
    action = np.zeros((2,) if kind is RobotEnv else (1, 2))
    said = rf"^Mine.observe returned 'steps' = 0.2.*: beyond its bounds \(0, 0.15\).*{__file__}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            env.reset(seed=0)
            for _ in range(4):
                seen = env.step(action)[0]
    assert [warning.category for warning in caught] == [AcsarWarning]
    assert re.search(said, str(caught[0].message))
    assert np.ravel(seen)[1] == pytest.approx(0.4)  # it is neither scaled nor clipped
    env.close()


class Helping(Plain):
    """Sound in Python."""

    def distance(self, state: State) -> float:
        return state.pose[0]


class CallsMethod(Helping):
    compiled = True

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        gained = 1.0
        return gained - self.distance(state)


class CallsSuper(Helping):
    compiled = True

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return super().observe(state, memory)


@pytest.mark.parametrize(
    ("task", "method", "called", "line"),
    [
        (CallsMethod, "reward", "self.distance", 2),
        (CallsSuper, "observe", "super", 1),
    ],
)
def test_what_a_compiled_method_cannot_call_is_said_when_a_batch_is_made(
    task: Any, method: str, called: str, line: int
) -> None:
    at = getattr(task, method).__code__.co_firstlineno + line
    said = rf"^{task.__name__}: {method}\(\) calls {called}\(\).*compilable.*\({__file__}:{at}\)$"
    with pytest.raises(ConfigError, match=said):
        make(RobotVectorEnv, task)
    make(RobotEnv, task).close()  # which runs it in Python
