"""Tasks: the goal, the observation, the reward and the end of an episode."""

from acsar_gym.tasks.crowd import Crowd, DynaBarn
from acsar_gym.tasks.episode import Assignment
from acsar_gym.tasks.goal import PointGoal
from acsar_gym.tasks.navigation import Barn, ObstacleGoal
from acsar_gym.tasks.path import PathFollow
from acsar_gym.tasks.state import Goal, Observation, State
from acsar_gym.tasks.task import OBSERVATION_LIMIT, Outcome, Task

__all__ = [
    "OBSERVATION_LIMIT",
    "Assignment",
    "Barn",
    "Crowd",
    "DynaBarn",
    "Goal",
    "Observation",
    "ObstacleGoal",
    "Outcome",
    "PathFollow",
    "PointGoal",
    "State",
    "Task",
]
