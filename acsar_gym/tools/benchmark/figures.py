"""Scores of a benchmark's episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from acsar_gym.errors import ConfigError
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.options import check_names
from acsar_gym.tasks.task import info_names, says_shortest_path
from acsar_gym.tools.evaluation.episode import Episode

WORST_CROSS_TRACK = 0.1
"""Mean cross-track error from which on following a path scores nothing [m]."""
COMPLETION_TIME = "completion_time"
CROSS_TRACK = "cross_track"
SUCCESS = "success"
"""Scores that every task has. Other names are numbers that a task reports."""


@dataclass(frozen=True, slots=True)
class Scoring:
    """What the score of an episode depends on besides its result."""

    name: str
    """COMPLETION_TIME, CROSS_TRACK, SUCCESS, or a number that the task reports."""
    top_speed: float
    """Of the robot [m/s]."""
    tolerance: float
    """Distance to the goal that is a success [m]."""

    @classmethod
    def of(cls, task: Task, name: str, top_speed: float) -> Scoring:
        """Return a task's scoring. ConfigError if the task doesn't report that number."""
        if name == COMPLETION_TIME and not says_shortest_path(task):
            raise ConfigError(
                f"{task_name(task)}: score {COMPLETION_TIME!r}: the task has no method "
                "shortest_path(): write one, or score 'success'"
            )
        names = (COMPLETION_TIME, CROSS_TRACK, SUCCESS, *info_names(task))
        check_names(f"{task_name(task)}: score {{}}", [name], names)
        return cls(name, top_speed, task.goal_tolerance)


def score_episode(episode: Episode, scoring: Scoring) -> float:
    """Return the score of an episode, 0 without success.

    COMPLETION_TIME is success weighted by completion time (Yokoyama, Ha & Batra 2021): T* / max(T,
    T*), where T is the time that it took, and T* that of the shortest path, up to the goal's
    tolerance, at the robot's top speed. It is 1 if the shortest path isn't known. CROSS_TRACK is 1
    minus the mean cross-track error / 10 cm, SUCCESS 1. Any other name is that of a number which
    the task reports at the end, such as "barn_score".
    """
    if not episode.success:
        return 0.0
    if scoring.name == CROSS_TRACK:
        return max(0.0, 1.0 - episode.cross_track / WORST_CROSS_TRACK)
    if scoring.name not in (COMPLETION_TIME, SUCCESS):
        return episode.told[scoring.name]
    if scoring.name == SUCCESS or math.isnan(episode.shortest):
        return 1.0
    fastest = max(episode.shortest - scoring.tolerance, 0.0) / scoring.top_speed
    return fastest / max(episode.time, fastest, 1e-9)
