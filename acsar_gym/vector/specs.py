"""Specs of environments as plain data, so that `spec.to_json()` works and makes an equal env."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from pydantic import BaseModel

from acsar_gym.dynamics import Randomization
from acsar_gym.links.faults import Faults
from acsar_gym.reading.objects import name_of
from acsar_gym.sensors import Sensor
from acsar_gym.tasks.base import Task


class PlainSpec:
    """Mixin of environments: keeps the arguments in Gymnasium's `spec` as plain data."""

    task: Task
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made this environment; None where it was made directly."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec = copy.copy(spec)
            named = {**spec.kwargs, "sensors": _named(spec.kwargs.get("sensors", ()))}
            spec.kwargs = {name: plain(named[name]) for name in spec.kwargs}
            object.__setattr__(self.task, "id", spec.id)  # a task's class may have several ids
        self._spec = spec


def _named(sensors: Sequence[Any]) -> list[Any]:
    """Replace functions among an env's `sensors` by their names, where these import them."""
    return [(isinstance(one, FunctionType) and name_of(one)) or one for one in sensors]


def plain(value: Any) -> Any:
    """Convert configs, faults, sensors, arrays, paths and containers of them for JSON.

    Other objects are returned unchanged.
    """
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    elif isinstance(value, Faults | Randomization):
        value = dataclasses.asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, type) and issubclass(value, Sensor):
        return name_of(value) or value
    return str(value.absolute()) if isinstance(value, Path) else value
