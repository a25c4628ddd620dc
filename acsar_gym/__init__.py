"""A Gymnasium environment for the ACSAR skid-steer robot, simulated or real behind one wire."""

from __future__ import annotations

import gymnasium

from acsar_gym import env, errors, kinematics, odometry, protocol
from acsar_gym.config import RobotConfig
from acsar_gym.links import Link, open_link
from acsar_gym.robot import Robot

__version__ = "0.1.0"
__all__ = [
    "Link",
    "Robot",
    "RobotConfig",
    "env",
    "errors",
    "kinematics",
    "odometry",
    "open_link",
    "protocol",
]

gymnasium.register(
    id="acsar_gym/PointGoal-v0",
    entry_point="acsar_gym.env:PointGoalEnv",
    vector_entry_point="acsar_gym.vector:PointGoalVectorEnv",
    max_episode_steps=200,
)
