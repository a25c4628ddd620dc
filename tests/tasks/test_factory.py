"""Mistakes in a user's class of tasks: one line that names the task and what is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
import pytest

import acsar_gym
from acsar_gym import Outcome, RobotEnv, State, Task
from acsar_gym.envs.ids import make_vec
from acsar_gym.errors import AcsarWarning, ConfigError
from acsar_gym.tasks import PathFollow, PointGoal
from acsar_gym.vector.env import RobotVectorEnv

ACTION = np.zeros(2, np.float32)


class MineWeights(NamedTuple):
    near: float = 0.5


class Plain(Task):
    """A sound task, whose attributes the tests replace."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"x": (-50.0, 50.0)}
    weights = MineWeights()

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return float(self.weights.near)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return (state.pose[0],)


@dataclass(frozen=True)
class WithField(Plain):
    tolerance: float = 0.15


def returning(value: Any) -> Any:
    return lambda *_: value


CLASSES: list[tuple[dict[str, Any], str]] = [
    ({"observation": {"x": (1.0, 0.0)}}, "Mine: observation: the bounds of a name must be"),
    ({"observation": {"x": 1.0, "y": 2.0}}, "Mine: observation: the bounds of a name must be"),
    ({"memory": {"odom_x": 0.0}}, "Mine: memory 'odom_x': info has that already"),
    ({"told": ("speed",)}, "Mine: told: no memory 'speed'"),
]
METHODS: list[tuple[dict[str, Any], str]] = [
    ({"outcome": returning(7)}, "Mine.outcome returned 7: must be an Outcome"),
    ({"reward": returning(np.nan)}, "Mine.reward returned nan: must be a finite number"),
    ({"observe": returning((1.0, 2.0))}, r"Mine.observe returned numbers of shape \(2,\): must be"),
    ({"reward": Task.reward}, "Mine: NotImplementedError: a task needs the method reward"),
]


@pytest.mark.parametrize(("attributes", "message"), [*CLASSES, *METHODS])
def test_task_mistake_is_one_line_at_the_latest_in_the_first_step(
    attributes: dict[str, Any], message: str
) -> None:
    task = type("Mine", (Plain,), attributes)
    with pytest.raises(ConfigError, match=f"^{message}") as caught:
        env = RobotEnv(task, "planar")
        env.reset(seed=0)
        env.step(ACTION)
    assert "\n" not in str(caught.value)
    if (attributes, message) in METHODS:
        assert not env.robot.active
        env.close()


@pytest.mark.parametrize("kind", [RobotEnv, RobotVectorEnv])
@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"tolerence": 1.0}, "unknown option 'tolerence' of WithField; did you mean 'tolerance'"),
        ({"weights": {"naer": 1.0}}, "unknown weight 'naer' of WithField; did you mean 'near'"),
        ({"weights": {"near": np.inf}}, "weight near = inf: must be a finite number"),
    ],
)
def test_option_that_is_wrong_is_refused(kind: Any, option: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        kind(WithField, **option)


def test_numbers_may_be_text() -> None:
    task = PointGoal(goal_distance=("0.5", 2), goal_tolerance="0.25")  # type: ignore[arg-type]
    assert (task.goal_distance, task.goal_tolerance, task.boundary) == ((0.5, 2.0), 0.25, 4.0)
    assert PathFollow(max_cross_track="0.4").max_cross_track == 0.4  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Posts(Plain):
    """Has an option that is an array."""

    posts: Any = None
    compiled = True

    def outcome(self, state: State, memory: Any) -> Outcome:
        return Outcome.SUCCESS if self.posts[1, 0] == 2.0 else Outcome.GOING


@pytest.mark.parametrize("kind", [RobotEnv, RobotVectorEnv])
def test_task_gets_an_array_as_it_is(kind: Any) -> None:
    env = kind(Posts, link="planar", posts=np.array([[1.0, 0.0], [2.0, 0.0]]))
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[2]
    env.close()


def test_weights_reach_the_single_env_and_a_batch() -> None:
    weights = {"progress": 3.0, "time": 0.5}
    action = np.array([[1.0, 0.0]] * 2, np.float32)
    single = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", weights=weights)
    batch = make_vec("acsar_gym/PointGoal-v0", 2, weights=weights)
    single.reset(seed=5)
    batch.reset(seed=5)
    reward = single.step(action[0])[1]
    assert float(reward) < -0.4
    assert batch.step(action)[1][0] == pytest.approx(reward, abs=1e-9)


def test_register_options_of_one_mode() -> None:
    acsar_gym.register(
        "mine/Modes-v0",
        task=PointGoal,
        kwargs={"on_fault": "raise", "goal_tolerance": 0.25, "link": "planar"},
        vector_kwargs={"autoreset_mode": "SameStep"},
    )
    single: Any = gymnasium.make("mine/Modes-v0").unwrapped
    batch: Any = make_vec("mine/Modes-v0", 2)
    assert single.task.goal_tolerance == batch.task.goal_tolerance == 0.25
    assert batch.autoreset_mode.value == "SameStep"

    with pytest.raises(ConfigError, match="unknown option 'thread' in vector_kwargs; did you mean"):
        acsar_gym.register("mine/Typo-v0", task=PointGoal, vector_kwargs={"thread": 2})
    assert "mine/Typo-v0" not in gymnasium.registry


class Beyond(Plain):
    """Observes more than it has declared."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        "ahead": (-50.0, 50.0),
        "steps": (0.0, 0.15),
    }

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return state.pose[0], state.time


def test_observation_beyond_its_bounds_is_reported_once() -> None:
    env = RobotEnv(Beyond, "planar")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            env.reset(seed=0)
            for _ in range(4):
                observation = env.step(ACTION)[0]
    assert [warning.category for warning in caught] == [AcsarWarning]
    message = "Beyond.observe returned 'steps' = 0.2: beyond its bounds (0, 0.15)"
    assert str(caught[0].message).startswith(message)
    assert observation[1] == pytest.approx(0.4)  # it is neither scaled nor clipped
    env.close()
