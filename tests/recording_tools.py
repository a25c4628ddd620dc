"""Makes small recordings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.recording import Recorder
from acsar_gym.worlds import Scene


def drive(path: Path, config: RobotConfig, ticks: int = 120, **options: Any) -> Path:
    """Record the planar robot with its LiDAR in curves, and return the path."""
    recorder = Recorder(path, {"command": "test"}, **options)
    with Robot(open_link("planar", config), config, ["lidar"], recorder) as robot:
        for tick in range(ticks):
            robot.drive(0.3, math.sin(tick / 20.0))
    return path


def record_env(path: Path, env_id: str, episodes: int = 2, **options: Any) -> Path:
    """Episodes of an env with random actions, some of them beyond [-1, 1]."""
    env = gymnasium.make(full_id(env_id), link="planar", record=path, **options)
    rng = np.random.default_rng(3)
    for seed in range(episodes):
        env.reset(seed=seed)
        for _ in range(40):
            if env.step(rng.uniform(-0.5, 1.0, 2).astype(np.float32))[2]:
                break
    env.close()
    return path


def record_drive(path: Path, *ways: list[tuple[float, float, int]]) -> Path:
    """One episode for each way, which is a list of (linear, angular, ticks)."""
    recorder = Recorder(path, {"command": "drive"})
    config = RobotConfig.of(None)
    with Robot(open_link("planar", config), config, recorder=recorder) as robot:
        for number, way in enumerate(ways):
            if number:
                robot.reset(Scene())
            for linear, angular, ticks in way:
                for _ in range(ticks):
                    robot.drive(linear, angular)
    return path
