"""The registered environments. The docstring of each class is the manual of its id.

Example:
    >>> from acsar_gym.envs import PointGoalEnv
    >>> env = PointGoalEnv(link="planar", goal_distance=(1.0, 2.0))
    >>> _, info = env.reset(seed=0, options={"goal": (1.5, 0.0)})
    >>> info["goal_distance"]
    1.5
    >>> env.close()
"""

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
