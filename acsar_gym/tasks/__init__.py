"""Tasks: goals, observation, reward and end of an episode, as pure functions of numbers."""

from acsar_gym.tasks.base import (
    OBSERVATION_LIMIT,
    Assignment,
    Course,
    Goal,
    Observation,
    Outcome,
    State,
    Task,
    signature,
)
from acsar_gym.tasks.goal import Barn, ObstacleGoal, PointGoal
from acsar_gym.tasks.path import PathFollow

__all__ = [
    "OBSERVATION_LIMIT",
    "Assignment",
    "Barn",
    "Course",
    "Goal",
    "Observation",
    "ObstacleGoal",
    "Outcome",
    "PathFollow",
    "PointGoal",
    "State",
    "Task",
    "signature",
]
