"""The registered environments; the docstring of each class is the manual of its id."""

from acsar_gym.envs.barn import BarnEnv, BarnVectorEnv
from acsar_gym.envs.obstacle_goal import ObstacleGoalEnv, ObstacleGoalVectorEnv
from acsar_gym.envs.path_follow import PathFollowEnv, PathFollowVectorEnv
from acsar_gym.envs.point_goal import PointGoalEnv, PointGoalVectorEnv

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
