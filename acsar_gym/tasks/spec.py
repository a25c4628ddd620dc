"""The spaces of an environment, and its arguments as plain data in Gymnasium's `spec`."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from pydantic import BaseModel

from acsar_gym.reading import object_name
from acsar_gym.sensors import Sensor
from acsar_gym.tasks.task import Task, observation_bounds


def task_spaces(task: Task, sensors: Iterable[Sensor]) -> tuple[Box, Box]:
    """Make the action and the observation space of a task, for one robot."""
    # The task's numbers come first, those of each sensor follow.
    bounds: list[Any] = [observation_bounds(task), *(sensor.bounds for sensor in sensors)]
    low, high = np.hstack(bounds).astype(np.float32)
    return Box(-1.0, 1.0, (2,), np.float32), Box(low, high, dtype=np.float32)


class PlainSpec:
    """Mixin of environments: keeps the arguments in Gymnasium's `spec` as plain data.

    So `spec.to_json()` works, and makes an equal env.
    """

    task: Task
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made this environment. None if it was made directly."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            # Gymnasium's own spec stays as it was made.
            spec = copy.copy(spec)
            spec.kwargs = to_plain(spec.kwargs)
            # Only sensors are found by name again: a task gets its functions as they are.
            if "sensors" in spec.kwargs:
                spec.kwargs["sensors"] = [_name_function(item) for item in spec.kwargs["sensors"]]
            object.__setattr__(self.task, "id", spec.id)  # a task's class may have several ids
        self._spec = spec


def _name_function(value: Any) -> Any:
    """Return the "module:name" of a function that can be imported. Other values stay."""
    return (isinstance(value, FunctionType) and object_name(value)) or value


def to_plain(value: Any) -> Any:
    """Convert configs, faults, sensors, arrays, paths and containers of them for JSON.

    Other objects are returned unchanged.
    """
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, type) and issubclass(value, Sensor):
        return object_name(value) or value
    return str(value.absolute()) if isinstance(value, Path) else value
