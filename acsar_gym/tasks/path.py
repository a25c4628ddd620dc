"""Follow a path by odometry: cross-track and heading error, and points of the path ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from acsar_gym.jit import compilable
from acsar_gym.tasks.options import store_positive
from acsar_gym.tasks.state import Floats, Pose, State
from acsar_gym.tasks.task import (
    OBSERVATION_LIMIT,
    Outcome,
    Task,
    clip_to,
    end_reward,
    relative_point,
)
from acsar_gym.trigonometry import cos_sin
from acsar_gym.worlds.search import PATH_SPACING

_SCALED = (-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
LOOKAHEAD = 4
"""How many points of the path ahead are observed."""
PATH_OBSERVATION: Mapping[str, tuple[float, float]] = {
    "cross_track_error": _SCALED,
    "heading_cos": (-1.0, 1.0),
    "heading_sin": (-1.0, 1.0),
    "remaining": (0.0, OBSERVATION_LIMIT),
    **{f"{axis}_{n}": _SCALED for n in range(1, LOOKAHEAD + 1) for axis in ("ahead", "left")},
    "linear_velocity": _SCALED,
    "angular_velocity": _SCALED,
    "last_linear": (-1.0, 1.0),
    "last_angular": (-1.0, 1.0),
    "max_linear": (0.0, OBSERVATION_LIMIT),
    "max_angular": (0.0, OBSERVATION_LIMIT),
}
POINT_TIME = 0.5
"""Time between two observed points of the path, at the robot's top speed [s]."""
TURN_SCALE = 4.0
"""The observed greatest yaw rate is divided by this [rad/s]."""
SEARCH_BACK = 10
SEARCH_AHEAD = 20
"""How many samples of the path behind and ahead of the last position on it are searched."""
TIE_DISTANCE = 1e-12
"""Squared distances that differ by less count as equal, as at a corner. The first piece is taken
[m^2]."""
LENGTH_SCALE = 10.0
"""The observed remaining length is divided by this [m]."""
PATH_TOLERANCE = 0.15
"""Success once odometry is this close to the end of the path [m]."""


class PathWeights(NamedTuple):
    """Weights of the terms of the reward."""

    progress: float = 0.1
    """Reward for covering as much of the path in a step as the top speed would."""
    time: float = 0.02
    """Cost of a step."""
    cross_track: float = 1.0
    """Cost of each metre of distance from the path."""
    backwards: float = 0.05
    """Cost of the backward part of the action."""
    success: float = 2.0
    """Reward at the end of the path."""
    failure: float = 2.0
    """Cost of leaving the bounds."""


@dataclass(frozen=True, kw_only=True)
class PathFollow(Task):
    """Follow a smooth path, or straight pieces between waypoints.

    Example:
        >>> from acsar_gym import RobotEnv
        >>> from acsar_gym.tasks import PathFollow
        >>> env = RobotEnv(PathFollow, link="planar", worlds="smooth_path:2")
        >>> _, info = env.reset(seed=0, options={"path": [(0.0, 0.0), (2.0, 0.0)]})
        >>> info["cross_track_error"]
        0.0
        >>> env.close()
    """

    max_cross_track: float = 0.5
    """An episode ends without success this far beside the path. Also scales the observed error
    [m]."""
    id = "acsar_gym/PathFollow-v0"
    observation = PATH_OBSERVATION
    memory: ClassVar[Mapping[str, float]] = {
        "cross_track_error": 0.0,
        "heading_error": 0.0,
        "path_progress": 0.0,
        "mean_cross_track_error": 0.0,
        "mean_heading_error": 0.0,
        "progress": 0.0,  # samples of the path
        "gain": 0.0,  # in the last step [m]
        "cross_sum": 0.0,
        "heading_sum": 0.0,
    }
    told = (
        "cross_track_error",
        "heading_error",
        "path_progress",
        "mean_cross_track_error",
        "mean_heading_error",
    )
    worlds = "smooth_path:train"
    goal_tolerance = PATH_TOLERANCE
    follows = True
    compiled = True
    weights = PathWeights()

    def __post_init__(self) -> None:
        store_positive(self, "max_cross_track")

    def begin(self, state: State, memory: Any) -> None:
        """Find the robot's position on the path."""
        locate_on_path(state, memory)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success near the path's end, out of bounds too far beside it. Keeps mean errors."""
        locate_on_path(state, memory)

        # The score: means over the steps until now.
        steps = math.floor(state.time / state.period + 0.5)
        memory.cross_sum += abs(memory.cross_track_error)
        memory.heading_sum += abs(memory.heading_error)
        memory.mean_cross_track_error = memory.cross_sum / steps
        memory.mean_heading_error = memory.heading_sum / steps

        x, y, _ = state.pose
        # Odometry decides, as on hardware.
        distance = math.sqrt((state.goal[0] - x) ** 2 + (state.goal[1] - y) ** 2)

        # A loop ends near its start: the rest of the path has to be short as well.
        if remaining_length(state, memory) <= PATH_TOLERANCE and distance <= PATH_TOLERANCE:
            return Outcome.SUCCESS
        is_beside = abs(memory.cross_track_error) > self.max_cross_track
        return Outcome.OUT_OF_BOUNDS if is_beside else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Sum of the terms of `PathWeights`."""
        weights = self.weights
        # In parts of what the top speed would cover in a step.
        progress = memory.gain / (state.max_twist[0] * state.period)
        cross_track = abs(memory.cross_track_error)
        backwards = min(state.action[0], 0.0)
        end = end_reward(outcome, weights.success, weights.failure)
        reward: float = weights.progress * progress - weights.time
        reward = reward - weights.cross_track * cross_track + weights.backwards * backwards
        return reward + end

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers that PATH_OBSERVATION names. Lengths and speeds are scaled."""
        cos, sin = cos_sin(state.pose[2])
        linear, angular = state.twist
        max_linear, max_angular = state.max_twist

        return (
            clip_to(memory.cross_track_error / self.max_cross_track, OBSERVATION_LIMIT),
            *cos_sin(memory.heading_error),
            min(remaining_length(state, memory) / LENGTH_SCALE, OBSERVATION_LIMIT),
            *point_ahead(state, memory, cos, sin, number=1),
            *point_ahead(state, memory, cos, sin, number=2),
            *point_ahead(state, memory, cos, sin, number=3),
            *point_ahead(state, memory, cos, sin, number=4),
            clip_to(linear / max_linear, OBSERVATION_LIMIT),
            clip_to(angular / max_angular, OBSERVATION_LIMIT),
            *state.action,
            min(max_linear, OBSERVATION_LIMIT),
            min(max_angular / TURN_SCALE, OBSERVATION_LIMIT),
        )


@compilable
def locate_on_path(state: State, memory: Any) -> None:
    """Find the robot's position on its path, near the last one, and write it into the memory."""
    last = len(state.path) - 1
    progress, cross_track, bearing = nearest_on_path(state.path, memory.progress, state.pose)
    # Samples are evenly spaced: `length / last` is the distance between two of them [m].
    memory.gain = (progress - memory.progress) * (state.length / last)
    memory.progress = progress
    memory.cross_track_error = cross_track
    memory.heading_error = heading_error(state.pose[2], bearing)
    memory.path_progress = progress / last


@compilable
def remaining_length(state: State, memory: Any) -> float:
    """Length of the path that is still ahead of the robot [m]."""
    last = len(state.path) - 1
    length: float = (last - memory.progress) * (state.length / last)
    return length


@compilable
def point_ahead(
    state: State, memory: Any, cos: float, sin: float, number: int
) -> tuple[float, float]:
    """How far an observed point of the path, from 1, lies ahead and to the left, clipped.

    In units of what the top speed drives until the last of these points. `cos` and `sin` are those
    of the robot's heading.
    """
    # A fast robot has to look farther ahead: points are spaced by time, not by length.
    stride = POINT_TIME * state.max_twist[0]

    # Slow robots would see one sample several times.
    samples = max(math.floor(number * stride / PATH_SPACING + 0.5), number)
    k = min(int(memory.progress) + samples, len(state.path) - 1)
    x = state.path[k, 0]
    y = state.path[k, 1]
    robot_x, robot_y, _ = state.pose
    ahead, left_by = relative_point(robot_x, robot_y, cos, sin, other_x=x, other_y=y)
    unit = LOOKAHEAD * stride
    return clip_to(ahead / unit, OBSERVATION_LIMIT), clip_to(left_by / unit, OBSERVATION_LIMIT)


@compilable
def nearest_on_path(path: Floats, progress: float, pose: Pose) -> tuple[float, float, float]:
    """Find the point of a path that is nearest to the robot, near the last point found.

    Args:
        path: (samples, 3): x [m], y [m], direction [rad].
        progress: The last position on the path [samples].
        pose: The robot's pose.

    Returns:
        Position on the path [samples], signed distance from it [m], positive to the left of the
        path, and the path's direction there [rad]. Before the first and behind the last sample it
        is the distance to that sample.
    """
    x, y, _ = pose
    # A path may cross itself: a search of all samples could jump to its other branch.
    first = max(int(progress) - SEARCH_BACK, 0)
    last = min(int(progress) + SEARCH_AHEAD, len(path) - 1)
    nearest = progress
    least_square = math.inf
    side = 0.0
    bearing = 0.0
    for k in range(first, last):
        # The nearest point of the piece from sample k to the next sample.
        along_x = path[k + 1, 0] - path[k, 0]
        along_y = path[k + 1, 1] - path[k, 1]
        dx = x - path[k, 0]
        dy = y - path[k, 1]
        share = (dx * along_x + dy * along_y) / (along_x * along_x + along_y * along_y)
        share = min(max(share, 0.0), 1.0)
        beside_x = dx - share * along_x
        beside_y = dy - share * along_y
        square = beside_x * beside_x + beside_y * beside_y

        # On a tie the first piece stays, in Python as in compiled code.
        if square < least_square - TIE_DISTANCE:
            least_square = square
            nearest = k + share
            bearing = path[k, 2]
            # This cross product is positive if the robot is to the left of the path.
            side = 1.0 if along_x * dy - along_y * dx >= 0.0 else -1.0
    return nearest, side * math.sqrt(least_square), bearing


@compilable
def heading_error(theta: float, bearing: float) -> float:
    """Heading minus path direction [rad], wrapped to [-pi, pi). Positive to the left."""
    error = theta - bearing
    return error - 2.0 * math.pi * math.floor(error / (2.0 * math.pi) + 0.5)
