"""The registered environments. The docstring of each class is the manual of its id."""

from acsar_gym.envs.manuals import (
    BarnEnv,
    BarnVectorEnv,
    CrowdEnv,
    CrowdVectorEnv,
    DynaBarnEnv,
    DynaBarnVectorEnv,
    ObstacleGoalEnv,
    ObstacleGoalVectorEnv,
    PathFollowEnv,
    PathFollowVectorEnv,
    PointGoalEnv,
    PointGoalVectorEnv,
)

__all__ = [
    "BarnEnv",
    "BarnVectorEnv",
    "CrowdEnv",
    "CrowdVectorEnv",
    "DynaBarnEnv",
    "DynaBarnVectorEnv",
    "ObstacleGoalEnv",
    "ObstacleGoalVectorEnv",
    "PathFollowEnv",
    "PathFollowVectorEnv",
    "PointGoalEnv",
    "PointGoalVectorEnv",
]
