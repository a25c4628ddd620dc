"""Spaces of a task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box

from acsar_gym.config import RobotConfig
from acsar_gym.sensors import Sensor
from acsar_gym.tasks.base import Task


def task_spaces(
    task: Task, config: RobotConfig, sensors: Sequence[Sensor] | None = None
) -> tuple[Box, Box]:
    """Action and observation space of a task, single or one row of many.

    `sensors` are those of the env's robot; without them the observation has the LiDAR's ranges
    where the task uses it.
    """
    rays = config.lidar.rays if "lidar" in task.sensors else 0
    bounds = [(np.zeros(rays), np.ones(rays))]
    if sensors is not None:
        bounds = [sensor.bounds for sensor in sensors]
    own = np.array(list(task.observation.values()), np.float32).reshape(-1, 2)
    low = np.concatenate([own[:, 0], *(low for low, _ in bounds)]).astype(np.float32)
    high = np.concatenate([own[:, 1], *(high for _, high in bounds)]).astype(np.float32)
    return Box(-1.0, 1.0, (2,), np.float32), Box(low, high, dtype=np.float32)
