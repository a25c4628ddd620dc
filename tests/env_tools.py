"""The ids, and envs of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium

from acsar_gym.envs.robot_env import RobotEnv

POINT_GOAL = "acsar_gym/PointGoal-v0"
IDS = {
    POINT_GOAL: {},
    "acsar_gym/ObstacleGoal-v1": {"worlds": "clutter:5"},
    "acsar_gym/Barn-v1": {"worlds": "barn:5"},
    "acsar_gym/Crowd-v0": {"worlds": "crowd:5"},
    "acsar_gym/DynaBarn-v0": {"worlds": "dynabarn:5"},
    "acsar_gym/PathFollow-v0": {"worlds": "waypoint_path:5"},
}
SEEING = ["acsar_gym/ObstacleGoal-v1", "acsar_gym/Barn-v1"]
LINKS = ["bullet", "planar"]
Make = Callable[..., gymnasium.Env[Any, Any]]


def make(env_id: str, link: Any = "planar", **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(env_id, link=link, **{**IDS[env_id], **options})


def inner(env: gymnasium.Env[Any, Any]) -> RobotEnv:
    assert isinstance(env.unwrapped, RobotEnv)
    return env.unwrapped
