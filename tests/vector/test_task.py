"""Tasks of users in a batch: their memory, their arrays, their mistakes, and numba's cache."""

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
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Outcome, PointGoal, State
from acsar_gym.tasks.task import is_compiled
from acsar_gym.vector.env import RobotVectorEnv

ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 3, 2)).astype(np.float32)


class Remembering(Task):
    """Plain Python: keeps the scan before, and a list."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"time": (0.0, 100.0)}
    memory: ClassVar[Mapping[str, Any]] = {"before": None, "history": [], "steps": 0.0}
    told: ClassVar[tuple[str, ...] | None] = ("steps",)
    sensors = ("lidar",)
    worlds = "clutter:3"

    def begin(self, state: State, memory: Any) -> None:
        memory.before = state.ranges

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        changed = float(abs(state.ranges - memory.before).sum())
        memory.before = state.ranges
        memory.history.append(changed)
        memory.steps = len(memory.history)
        return changed + len(memory.history)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        return (state.time,)


def test_what_a_plain_task_keeps_is_its_own() -> None:
    batch, one = RobotVectorEnv(Remembering, 3), RobotEnv(Remembering, "planar")
    for seed in (4, 5):  # the second episode remembers nothing of the first
        batch.reset(seed=seed)
        one.reset(seed=seed)
        for action in ACTIONS:
            *_, info = batch.step(action)
            _, reward, *_, told = one.step(action[0])
            assert batch.batch.tables.rewards[0] == pytest.approx(reward, abs=1e-9)
            assert info["steps"][0] == told["steps"]
        assert told["steps"] == len(ACTIONS)
    batch.close()
    one.close()


class Backwards(PointGoal):
    """Half of a task overridden: its reward counts, in every mode."""

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return -float(state.action[0])


def test_a_subclass_has_its_own_reward_in_a_batch() -> None:
    assert is_compiled(PointGoal())
    assert not is_compiled(Backwards())
    batch = RobotVectorEnv(Backwards, 3)
    batch.reset(seed=0)
    _, rewards, *_ = batch.step(ACTIONS[0])
    assert rewards == pytest.approx(-ACTIONS[0, :, 0])
    batch.close()


USER = """
from acsar_gym import Task
from {helper} import bonus


class Mine(Task):
    observation = {{"time": (0.0, 100.0)}}
    compiled = True

    def reward(self, state, memory, outcome):
        return bonus(state.time) + {own}

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
import numpy as np
sys.path.insert(0, ".")
from acsar_gym.vector.env import RobotVectorEnv
from mine import Mine
batch = RobotVectorEnv(Mine, 2)
batch.reset(seed=0)
print(batch.step(np.zeros((2, 2)))[1][0], flush=True)
"""


def test_a_task_whose_helper_was_edited_is_compiled_anew(tmp_path: Path) -> None:
    said = []
    (tmp_path / "mine.py").write_text(USER.format(helper="helper", own="10.0"))
    for bonus in ("1.0", "2.0"):
        (tmp_path / "helper.py").write_text(HELPER.format(bonus=bonus))
        done = subprocess.run(
            [sys.executable, "-c", RUN], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        said.append(float(done.stdout))
    assert said == [11.0, 12.0]


class Unsound(Task):
    """From its second step on, one of its methods goes wrong."""

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {"time": (0.0, 9.0), "x": (0.0, 9.0)}
    sensors = ("lidar",)
    worlds = "smooth_path:2"
    follows = True
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
    def outcome(self, state: State, memory: Any) -> Any:
        return 7 if state.time > 0.15 else Outcome.GOING


class Bending(Unsound):
    """Changes the path that it is told, which all robots of a world share."""

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        if state.time > 0.15:
            state.path[:, 0] += 1.0
        return 0.0


def unsound(base: type[Task], **attributes: Any) -> type[Task]:
    return type("Wrong", (base,), attributes)


MISTAKES: list[Any] = [
    (Late, {}, r"outcome returned 7"),
    (Bending, {}, r": reward\(\) raised ValueError: .* read-only"),
    (Unsound, {"gain": float("nan")}, r"reward returned .*nan"),
    (Unsound, {"bias": float("-inf")}, r"observe returned {'x': -inf}"),
]
COMPILED_MISTAKES: list[Any] = [
    (Unsound, {"compiled": True, **attributes}, said)
    for attributes, said in (
        ({"gain": float("nan")}, "reward returned .*nan"),
        ({"bias": float("-inf")}, "{'x': -inf}"),
        ({"rays": 640}, "IndexError"),
    )
]


@pytest.mark.parametrize(
    ("base", "attributes", "said", "mode"),
    [(*mistake, mode) for mistake in MISTAKES for mode in ("single", "NextStep", "SameStep")]
    + [(*mistake, mode) for mistake in COMPILED_MISTAKES for mode in ("NextStep", "SameStep")],
)
def test_what_a_step_cannot_use_is_named_and_a_reset_recovers(
    base: type[Task], attributes: dict[str, Any], said: str, mode: str
) -> None:
    task = unsound(base, **attributes)
    env: Any = RobotEnv(task, "planar")
    if mode != "single":
        env = RobotVectorEnv(task, 3, autoreset_mode=mode, max_episode_steps=2)
    action = ACTIONS[0, 0] if mode == "single" else ACTIONS[0]
    for _ in range(2):
        env.reset(seed=0)
        env.step(action)
        with pytest.raises(ConfigError, match=rf"^Wrong.*{said}"):
            env.step(action)
    env.close()


class Hasty(Remembering):
    def begin(self, state: State, memory: Any) -> None:
        memory.rate = 1.0 / state.pose[0]


OWN_SUCCESS = {
    "memory": {"before": None, "history": [], "is_success": 1.0},
    "told": ("is_success",),
}


@pytest.mark.parametrize(
    ("base", "attributes", "said"),
    [
        (Remembering, OWN_SUCCESS, "'is_success': info has that already"),
        (Hasty, {}, r"begin\(\) raised ZeroDivisionError: .*\.py:\d+"),
        (Remembering, {"memory": None}, "memory = "),
        (Remembering, {"sensors": Sensor}, "sensors = "),
    ],
)
def test_mistakes_of_a_class_are_found_before_the_first_reset(
    base: type[Task], attributes: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=f"Wrong.*{said}"):
        RobotEnv(unsound(base, **attributes), "planar")


class Writing(Unsound):
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        memory.turns = 0.0


class Reading(Unsound):
    compiled = True

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        return float(memory.turns) if state.time > 0.15 else 0.0


@pytest.mark.parametrize("task", [Writing, Reading])
def test_what_a_memory_does_not_declare_is_named(task: type[Task]) -> None:
    batch = RobotVectorEnv(task)
    with pytest.raises(ConfigError, match=r"memory\.turns isn't declared"):
        batch.reset(seed=0)
        batch.step(ACTIONS[0, :1])
    batch.close()
