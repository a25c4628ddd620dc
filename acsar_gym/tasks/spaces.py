"""Spaces of a task."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from acsar_gym.config import RobotConfig
from acsar_gym.tasks.base import Task


def task_spaces(task: Task, config: RobotConfig) -> tuple[Box, Box]:
    """Action and observation space of a task, single or one row of many."""
    rays = config.lidar.rays if task.sees else 0
    low = np.array([*task.low(), *([0.0] * rays)], np.float32)
    high = np.array([*task.high(), *([1.0] * rays)], np.float32)
    return Box(-1.0, 1.0, (2,), np.float32), Box(low, high, dtype=np.float32)
