"""Spaces of a task."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from acsar_gym.config import RobotConfig
from acsar_gym.tasks.base import Task


def task_spaces(task: Task, config: RobotConfig) -> tuple[Box, Box]:
    """Action and observation space of a task, single or one row of many."""
    rays = config.lidar.rays if "lidar" in task.sensors else 0
    bounds = [*task.observation.values(), *([(0.0, 1.0)] * rays)]
    low, high = np.array(bounds, np.float32).reshape(-1, 2).T
    return Box(-1.0, 1.0, (2,), np.float32), Box(low.copy(), high.copy(), dtype=np.float32)
