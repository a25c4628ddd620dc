"""The action and observation space of a task."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from gymnasium.spaces import Box

from acsar_gym.sensors import Sensor
from acsar_gym.tasks.base import Task


def task_spaces(task: Task, sensors: Iterable[Sensor]) -> tuple[Box, Box]:
    """Make the action and the observation space of a task, for one robot.

    Args:
        task: whose numbers come first in an observation.
        sensors: whose numbers follow, in this order.

    Returns:
        The action space, shape (2,) in [-1, 1], and the observation space, shape (numbers,).
    """
    own = np.array(list(task.observation.values()), np.float64).reshape(-1, 2).T
    bounds = np.hstack([own, *(np.array(sensor.bounds) for sensor in sensors)])
    low, high = bounds.astype(np.float32)
    return Box(-1.0, 1.0, (2,), np.float32), Box(low, high, dtype=np.float32)
