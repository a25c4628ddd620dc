"""What is wrong with a task's class, or with an env's sensors, is one clear error."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.envs.base import RobotEnv
from acsar_gym.errors import ConfigError
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import State, Task
from acsar_gym.tasks.factory import make_task
from acsar_gym.vector.env import RobotVectorEnv


class Plain(Task):
    """A task that is right."""

    observation = {"x": (-9.0, 9.0)}  # noqa: RUF012 - as users write it
    memory = {"m": 0.0}  # noqa: RUF012

    def reward(self, state: State, memory: Any, outcome: Any) -> float:
        """Nothing."""
        return 0.0

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """Where it is."""
        return (state.pose[0],)


class One(Sensor):
    """Reads nothing."""

    name, size = "one", 1

    def read(self, truth: Any, now: float) -> Any:
        """Zero."""
        return [0.0]


@pytest.mark.parametrize(
    ("attribute", "value"),
    [("observation", ["x"]), ("memory", ["m"]), ("memory", None), ("told", "m"), ("sensors", One)],
)
def test_attributes_of_a_wrong_type(attribute: str, value: Any) -> None:
    wrong = type("Wrong", (Plain,), {attribute: value})
    with pytest.raises(ConfigError, match=rf"Wrong: {attribute} = .*: must be a "):
        make_task(wrong, {})


@pytest.mark.parametrize("env", [RobotEnv, RobotVectorEnv])
@pytest.mark.parametrize("sensors", [One, "lidar", None])
def test_sensors_are_a_list(env: Any, sensors: Any) -> None:
    with pytest.raises(ConfigError, match=r"sensors = .*: must be a list"):
        env(Plain, sensors=sensors)
