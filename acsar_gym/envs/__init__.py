"""The registered environments; the docstring of each class is the manual of its id."""

from acsar_gym.envs.manuals import (
    BarnEnv,
    BarnVectorEnv,
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
    "ObstacleGoalEnv",
    "ObstacleGoalVectorEnv",
    "PathFollowEnv",
    "PathFollowVectorEnv",
    "PointGoalEnv",
    "PointGoalVectorEnv",
]
