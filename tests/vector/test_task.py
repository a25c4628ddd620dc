"""Tasks of users in a batch: what can't be used in them, and numba's cache."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from acsar_gym import RobotEnv, Task
from acsar_gym.errors import ConfigError
from acsar_gym.tasks import Outcome, PointGoal, State
from acsar_gym.vector.env import RobotVectorEnv

ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 2)).astype(np.float32)


class Backwards(PointGoal):
    """Half of a compiled task overridden."""

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return -float(state.action[0])


def test_task_that_is_not_compiled_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"compiled = True in Backwards.*='async'$"):
        RobotVectorEnv(Backwards)


class Listing(PointGoal):
    """Remembers a list, which a compiled task can't."""

    memory: ClassVar[Mapping[str, Any]] = {"goal_distance": 0.0, "places": [0.0, 1.0]}
    told = ("goal_distance",)
    compiled = True


def test_memory_that_is_no_number_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^Listing: .*sequence"):
        RobotVectorEnv(Listing)


class Mixed(Task):
    """Returns numbers of several types."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        "time": (0.0, 9.0),
        "one": (0.0, 1.0),
        "moved": (0.0, 1.0),
    }
    compiled = True

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return 2

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return state.time, 1, state.time > 0.0


def test_task_returns_any_numbers() -> None:
    batch = RobotVectorEnv(Mixed, 3)
    assert batch.reset(seed=0)[0].tolist() == [[0.0, 1.0, 0.0]] * 3
    observations, rewards, *_ = batch.step(ACTIONS)
    assert observations == pytest.approx(np.array([[0.1, 1.0, 1.0]] * 3))
    assert rewards.tolist() == [2.0] * 3


USER = """
from acsar_gym import Task
from helper import bonus


class Mine(Task):
    observation = {"time": (0.0, 100.0)}
    compiled = True

    def reward(self, state, memory, outcome):
        return bonus(state.time) + 10.0

    def observe(self, state, memory):
        return (state.time,)
"""
HELPER = """
from acsar_gym.jit import compilable


@compilable
def bonus(time):
    return {bonus}
"""
RUN = """
import sys
sys.path.insert(0, ".")
from acsar_gym.tasks.task import TASK_METHODS
from acsar_gym.vector.kernel.binding import _name_in_cache
from mine import Mine
print(_name_in_cache(Mine, TASK_METHODS))
"""


def test_task_whose_helper_was_edited_has_another_name_in_the_cache(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(USER)
    names = []
    for bonus in ("1.0", "1.0", "2.0"):
        (tmp_path / "helper.py").write_text(HELPER.format(bonus=bonus))
        command = [sys.executable, "-c", RUN]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        names.append(done.stdout)
    assert names[0] == names[1] != names[2]


class Unsound(Task):
    """From its second step on, a method goes wrong."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"time": (0.0, 9.0), "x": (0.0, 9.0)}
    sensors = ("lidar",)
    worlds = "smooth_path:2"
    follows = True
    compiled = True
    gain: float = 0.0
    bias: float = 0.0
    rays: int = 0

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        late = state.time > 0.15
        ray: float = state.ranges[int(self.rays * late)]
        return ray + (self.gain if late else 0.0)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return state.time, 1.0 + (self.bias if state.time > 0.15 else 0.0)


class Late(Unsound):
    compiled = True

    def outcome(self, state: State, memory: Any) -> Any:
        return 7 if state.time > 0.15 else Outcome.GOING


@pytest.mark.parametrize(
    ("base", "attributes", "message"),
    [
        (Late, {}, "outcome returned"),
        (Unsound, {"gain": float("nan")}, "reward returned .*nan"),
        (Unsound, {"bias": float("-inf")}, "observe returned {'x': -inf}"),
        (Unsound, {"rays": 640}, "IndexError"),
    ],
)
@pytest.mark.parametrize("mode", ["single", "NextStep", "SameStep"])
def test_task_mistake_in_a_step_is_named_and_a_reset_recovers(
    base: type[Task], attributes: dict[str, Any], message: str, mode: str
) -> None:
    task = type("Wrong", (base,), {"compiled": True, **attributes})
    env: Any = RobotEnv(task, "planar")
    if mode != "single":
        env = RobotVectorEnv(task, 3, autoreset_mode=mode, max_episode_steps=2)
    action = ACTIONS[0] if mode == "single" else ACTIONS
    for _ in range(2):
        env.reset(seed=0)
        env.step(action)
        with pytest.raises(ConfigError, match=rf"^Wrong.*{message}"):
            env.step(action)


class Touching(PointGoal):
    compiled = True

    def outcome(self, state: State, memory: Any) -> Any:
        return state.contact


def test_outcome_that_is_true_or_false_is_refused() -> None:
    batch = RobotVectorEnv(Touching, 3)
    batch.reset(seed=0)
    with pytest.raises(ConfigError, match=r"^Touching: .*outcome returned True or False"):
        batch.step(ACTIONS)


class TooFew(Unsound):
    compiled = True

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return (state.time,)


class Untyped(Unsound):
    compiled = True

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return state.nothing  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (TooFew, "observe returned more or fewer numbers"),
        (Untyped, r"^Untyped: numba can't compile .*reward\(\)\n(.|\n)*nothing"),
    ],
)
def test_task_mistake_in_a_reset_is_named(task: type[Task], message: str) -> None:
    batch = RobotVectorEnv(task)
    with pytest.raises(ConfigError, match=message):
        batch.reset(seed=0)
