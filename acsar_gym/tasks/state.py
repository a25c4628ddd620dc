"""What a task receives after every step, and the keys of info."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Observation = NDArray[np.float32]
Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Goal = tuple[float, float]
Twist = tuple[float, float]
WheelSpeeds = tuple[float, float, float, float]

NO_RANGES: Floats = np.zeros(0)
NO_PATH: Floats = np.zeros((0, 3))
NOTHING_SENSED: Observation = np.zeros(0, np.float32)


class State(NamedTuple):
    """What a task knows after every step. On a real robot all of it is known except `contact`.

    Poses and points are in the odometry frame, in which the robot starts at the origin. The single
    env and a batch create it in one place each: `RobotEnv._observe` and `vector.kernel.task`.

    Example:
        A task is tested without an env:

        >>> from acsar_gym import State
        >>> from acsar_gym.tasks import PointGoal
        >>> state = State(pose=(0.9, 0.0, 0.0), goal=(1.0, 0.0))
        >>> PointGoal().outcome(state, memory=None).name
        'SUCCESS'
    """

    pose: Pose = (0.0, 0.0, 0.0)
    """Pose by odometry: x [m], y [m], theta [rad]."""
    twist: Twist = (0.0, 0.0)
    """Velocity by odometry: linear [m/s], angular [rad/s]."""
    wheel_speeds: WheelSpeeds = (0.0, 0.0, 0.0, 0.0)
    """Wheel speeds by the encoders, in the order of the wheels a to d [rad/s]."""
    action: Twist = (0.0, 0.0)
    """The last action (linear, angular), in [-1, 1]. Zeros at a reset."""
    sent: Twist = (0.0, 0.0)
    """The velocity command of the last tick, after all limits: linear [m/s], angular [rad/s]."""
    reason: int = 0
    """Why `sent` differs from the action: a `safety.layer.Reason`, or 0 if it doesn't differ."""
    ranges: Floats = NO_RANGES
    """(rays,): the LiDAR's newest scan [m]. Empty if the task uses none."""
    edges: Floats = NO_RANGES
    """(rays,): distance from the LiDAR to the edge of the footprint along each ray [m]."""
    sensed: Observation = NOTHING_SENSED
    """(numbers,): what all sensors add to the observation, scaled as it is there."""
    time: float = 0.0
    """Time since the reset, a whole number of env steps [s]."""
    feedback_age: float = 0.0
    """Time since the last feedback line of the board [s]."""
    contact: bool = False
    """Whether a simulated robot has touched an obstacle. Always False on hardware."""
    goal: Goal = (1.0, 0.0)
    """The goal: x, y [m]."""
    path: Floats = NO_PATH
    """(samples, 3): x [m], y [m] and direction [rad] every 0.05 m along the path to follow.
    Empty unless the task sets `follows`."""
    length: float = math.nan
    """Length of the world's own path from start to goal [m]. NaN if the world has none."""
    max_twist: Twist = (1.0, 1.0)
    """The velocity of a full action: linear [m/s], angular [rad/s]."""
    period: float = 0.1
    """Duration of an env step [s]."""


class StepInfo(NamedTuple):
    """What info contains after every step of every task, under the names of the fields.

    The numbers that only a simulator knows are NaN on hardware. A batch has an array with a row
    for each robot under each key.
    """

    is_success: float
    """Whether the episode has ended at the goal, by odometry."""
    odom_x: float
    """Pose by odometry [m]."""
    odom_y: float
    """Pose by odometry [m]."""
    odom_theta: float
    """Pose by odometry [rad]."""
    feedback_age: float
    """Time since the last feedback line of the board [s]."""
    sent_linear: float
    """The velocity command of the last tick, after all limits [m/s]."""
    sent_angular: float
    """The turn rate of that command [rad/s]."""
    sent_reason: float
    """Why it differs from the action: a `safety.layer.Reason`, or 0 if it doesn't differ."""
    true_x: float
    """True pose in the odometry frame [m]."""
    true_y: float
    """True pose in the odometry frame [m]."""
    true_theta: float
    """True pose in the odometry frame [rad]."""
    true_contact: float
    """Whether the robot has touched an obstacle."""
    true_goal_distance: float
    """Distance from the true pose to the goal [m]."""
    odometry_error: float
    """Distance between the pose by odometry and the true pose [m]."""


class CrowdInfo(NamedTuple):
    """What info contains in addition in worlds that move. NaN on hardware. See `worlds.crowd`."""

    closest_person: float
    """Distance from the robot's hull to the nearest person's, at most 100 [m]."""
    time_to_collision: float
    """Time until robot and a person would touch if all kept their velocities, at most 10 [s]."""
    intrusions: float
    """How often the robot has come within 0.45 m of a person in the episode."""
    person_contact: float
    """0: none, 1: the robot ran into a person, 2: a person ran into the robot."""


OPTIONAL_INFO = ("world", "scan_age", "scan_stale", "fault", "fault_reason")
"""Keys of info that some envs have."""
INFO_KEYS = frozenset((*StepInfo._fields, *CrowdInfo._fields, *OPTIONAL_INFO))
"""All keys of info that don't belong to a task, a user's sensor or a randomized parameter."""
