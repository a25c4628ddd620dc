"""A Gymnasium environment for the ACSAR skid-steer robot, simulated or real behind one wire."""

from __future__ import annotations

import gymnasium

from acsar_gym import envs, errors, kinematics, odometry, protocol
from acsar_gym.config import RobotConfig
from acsar_gym.links import Link, open_link
from acsar_gym.robot import Robot
from acsar_gym.worlds import World

__version__ = "0.1.0"
__all__ = [
    "Link",
    "Robot",
    "RobotConfig",
    "World",
    "envs",
    "errors",
    "kinematics",
    "odometry",
    "open_link",
    "protocol",
]

for _name, _steps, _threshold in (
    ("PointGoal", 200, 4.0),
    ("ObstacleGoal", 400, 10.0),
    ("Barn", 1000, 14.0),
    ("PathFollow", 400, 10.0),
):
    gymnasium.register(
        id=f"acsar_gym/{_name}-v0",
        entry_point=f"acsar_gym.envs:{_name}Env",
        vector_entry_point=f"acsar_gym.vectors:{_name}VectorEnv",
        max_episode_steps=_steps,
        reward_threshold=_threshold,
    )
