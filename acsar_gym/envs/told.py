"""Make the State for the task, and the info for the agent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.errors import (
    BoardGarbledError,
    BoardSilentError,
    LidarError,
    LinkError,
    LinkLostError,
    TaskError,
    WheelError,
    shown,
)
from acsar_gym.lidars.base import edges, newest_scan
from acsar_gym.robot import Robot
from acsar_gym.tasks import Observation, Outcome, State, Task
from acsar_gym.tasks.base import NO_PATH, NO_RANGES
from acsar_gym.tasks.episode import Episode, check_observation
from acsar_gym.tasks.made import named
from acsar_gym.worlds import Pose
from acsar_gym.worlds.scene import to_odometry

Info = dict[str, Any]
FAULT_CODES = (
    (BoardGarbledError, 2),
    (BoardSilentError, 1),
    (LinkLostError, 3),
    (LidarError, 4),
    (WheelError, 6),
)
"""Numbers of errors in info's `fault`; subclasses come first."""
NOWHERE: Pose = (math.nan, math.nan, math.nan)
"""The true pose on links without ground truth."""


def fault_code(error: LinkError) -> int:
    """Number of a link's error for info's `fault`; 5 for those that aren't in `FAULT_CODES`."""
    return next((code for kind, code in FAULT_CODES if isinstance(error, kind)), 5)


def state_of(
    robot: Robot,
    episode: Episode,
    action: tuple[float, float],
    sensed: Observation,
    ticks: int,
    *,
    contact: bool,
) -> State:
    """Make the State of a robot after a reset or step.

    Args:
        robot: with the odometry and the sensors.
        episode: with the goal, the path and the number of steps.
        action: the last one, in [-1, 1].
        sensed: numbers of all sensors, as in the observation.
        ticks: control periods of an env step.
        contact: whether a simulated robot has touched an obstacle.
    """
    assignment, config = episode.assignment, robot.config
    scan = newest_scan(robot.sensors)
    return State(
        pose=robot.odometry.pose,
        twist=robot.odometry.twist,
        wheel_speeds=robot.speeds,
        action=action,
        sent=robot.safety.sent,
        reason=int(robot.safety.reason),
        ranges=NO_RANGES if scan is None else scan.ranges,
        edges=NO_RANGES if scan is None else edges(config),
        sensed=sensed,
        time=episode.steps * ticks * config.period,
        feedback_age=robot.feedback_age,
        contact=contact,
        goal=assignment.goal,
        path=NO_PATH if assignment.path is None else assignment.path,
        length=assignment.length,
        max_twist=(config.max_linear, config.max_angular),
        period=ticks * config.period,
    )


def observed(episode: Episode, state: State, task: Task) -> Observation:
    """The task's own part of the observation, (numbers,).

    Args:
        episode: with the memory.
        state: after the reset or step.
        task: of the episode.

    Raises:
        TaskError: the task returned something else than so many finite numbers.
    """
    given = episode.observe(state)
    try:
        numbers = np.array(given, np.float32)
    except (TypeError, ValueError):
        raise TaskError(f"{named(task)}.observe returned {shown(given)}: must be numbers") from None
    if numbers.shape != (len(task.observation),):
        raise TaskError(
            f"{named(task)}.observe returned numbers of shape {numbers.shape}: must be "
            f"({len(task.observation)},)"
        )
    check_observation(task, numbers)
    return numbers


def info_of(episode: Episode, state: State, truth: GroundTruth | None) -> Info:
    """Make the info that every environment has; ground truth is NaN on links without it.

    Args:
        episode: with the start of the robot, and what the task adds.
        state: after the reset or step.
        truth: of the robot, in the frame of its world; None on hardware.
    """
    x, y, theta = state.pose
    start = episode.assignment.start
    true_x, true_y, true_theta = to_odometry(start, truth.pose) if truth else NOWHERE
    goal_x, goal_y = state.goal
    return {
        "is_success": float(episode.outcome is Outcome.SUCCESS),
        "odom_x": x,
        "odom_y": y,
        "odom_theta": theta,
        "feedback_age": state.feedback_age,
        "sent_linear": state.sent[0],
        "sent_angular": state.sent[1],
        "sent_reason": float(state.reason),
        "true_x": true_x,
        "true_y": true_y,
        "true_theta": true_theta,
        "true_contact": float(truth.contact) if truth else math.nan,
        "true_goal_distance": math.hypot(goal_x - true_x, goal_y - true_y),
        "odometry_error": math.hypot(true_x - x, true_y - y),
    } | episode.info()
