"""Follow a path by odometry: cross-track and heading error, and points of the path ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.jit import compilable
from acsar_gym.tasks.options import check_positive
from acsar_gym.tasks.state import Floats, State
from acsar_gym.tasks.task import OBSERVATION_LIMIT, Outcome, Task, clip_to, relative_point
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
POINT_TIME = 0.5  # between two observed points of the path, at the robot's top speed [s]
TURN_SCALE = 4.0  # the observed greatest yaw rate is divided by this [rad/s]
SEARCH_BACK, SEARCH_AHEAD = 10, 20
"""How many samples of the path behind and ahead of the last position on it are searched."""
TIE_DISTANCE = 1e-12
"""Squared distances that differ by less count as equal, as at a corner; the first piece is taken
[m^2]."""
LENGTH_SCALE = 10.0  # the observed remaining length is divided by this [m]
PATH_TOLERANCE = 0.15  # success once odometry is this close to the end of the path [m]


@dataclass(frozen=True, kw_only=True)
class PathFollow(Task):
    """Follow a smooth path, or straight pieces between waypoints."""

    max_cross_track: float = 0.5
    """An episode ends without success this far beside the path; also scales the observed error
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
        "bearing": 0.0,
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

    def __post_init__(self) -> None:
        most = check_positive("max_cross_track", self.max_cross_track)
        object.__setattr__(self, "max_cross_track", most)

    def begin(self, state: State, memory: Any) -> None:
        """Find the robot's position on the path."""
        locate_on_path(state, memory)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success near the path's end, out of bounds too far beside it; keeps mean errors."""
        locate_on_path(state, memory)
        steps = math.floor(state.time / state.period + 0.5)
        memory.cross_sum += abs(memory.cross_track_error)
        memory.heading_sum += abs(memory.heading_error)
        memory.mean_cross_track_error = memory.cross_sum / steps
        memory.mean_heading_error = memory.heading_sum / steps
        x, y, _ = state.pose
        far = math.sqrt((state.goal[0] - x) ** 2 + (state.goal[1] - y) ** 2)
        if remaining_length(state, memory) <= PATH_TOLERANCE and far <= PATH_TOLERANCE:
            return Outcome.SUCCESS
        beside = abs(memory.cross_track_error) > self.max_cross_track
        return Outcome.OUT_OF_BOUNDS if beside else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `path_reward`."""
        gained = memory.gain / (state.max_twist[0] * state.period)
        return path_reward(gained, memory.cross_track_error, state.action[0], outcome)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers that PATH_OBSERVATION names; lengths and speeds are scaled."""
        limit, (cos, sin) = OBSERVATION_LIMIT, cos_sin(state.pose[2])
        fastest, turning = state.max_twist
        return (
            clip_to(memory.cross_track_error / self.max_cross_track, limit),
            *cos_sin(memory.heading_error),
            min(remaining_length(state, memory) / LENGTH_SCALE, limit),
            *point_ahead(state, memory, cos, sin, 1),
            *point_ahead(state, memory, cos, sin, 2),
            *point_ahead(state, memory, cos, sin, 3),
            *point_ahead(state, memory, cos, sin, 4),
            clip_to(state.twist[0] / fastest, limit),
            clip_to(state.twist[1] / turning, limit),
            *state.action,
            min(fastest, limit),
            min(turning / TURN_SCALE, limit),
        )


@compilable
def locate_on_path(state: State, memory: Any) -> None:
    """Find the robot's position on its path, near the last one, and write it into the memory."""
    x, y, theta = state.pose
    last, before = len(state.path) - 1, memory.progress
    progress, cross, bearing = nearest_on_path(state.path, last, before, x, y)
    memory.progress, memory.bearing = progress, bearing
    memory.gain = (progress - before) * (state.length / last)
    memory.cross_track_error = cross
    memory.heading_error = heading_error(theta, bearing)
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
    stride = POINT_TIME * state.max_twist[0]
    samples = max(math.floor(number * stride / PATH_SPACING + 0.5), number)
    k = min(int(memory.progress) + samples, len(state.path) - 1)
    x, y = state.path[k, 0], state.path[k, 1]
    ahead, left = relative_point(state.pose[0], state.pose[1], cos, sin, x, y)
    unit = LOOKAHEAD * stride
    return clip_to(ahead / unit, OBSERVATION_LIMIT), clip_to(left / unit, OBSERVATION_LIMIT)


@compilable
def nearest_on_path(
    path: Floats, last: int, progress: float, x: float, y: float
) -> tuple[float, float, float]:
    """Find the point of a path that is nearest to a given point, near the last one found.

    Args:
        path: (samples, 3): x [m], y [m], direction [rad].
        last: number of the path's last sample.
        progress: the last position on the path [samples].
        x: of the point [m].
        y: of the point [m].

    Returns:
        Position on the path [samples]; signed distance from it [m], positive to the left of the
        path; and the path's direction there [rad]. Before the first and behind the last sample it
        is the distance to that sample.
    """
    first = max(int(progress) - SEARCH_BACK, 0)
    best, place, side, bearing = math.inf, progress, 0.0, 0.0
    for k in range(first, min(int(progress) + SEARCH_AHEAD, last)):
        ex, ey = path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1]
        dx, dy = x - path[k, 0], y - path[k, 1]
        share = (dx * ex + dy * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        rx, ry = dx - share * ex, dy - share * ey
        square = rx * rx + ry * ry
        if square < best - TIE_DISTANCE:
            best, place, bearing = square, k + share, path[k, 2]
            side = 1.0 if ex * dy - ey * dx >= 0.0 else -1.0
    return place, side * math.sqrt(best), bearing


@compilable
def heading_error(theta: float, bearing: float) -> float:
    """Heading minus path direction [rad], wrapped to [-pi, pi); positive to the left."""
    error = theta - bearing
    return error - 2.0 * math.pi * math.floor(error / (2.0 * math.pi) + 0.5)


@compilable
def path_reward(gained: float, cross: float, linear: float, outcome: int) -> float:
    """Reward of a step along a path.

        0.1 gained - 0.02 - |cross| + 0.05 min(linear, 0) + (2 at success, -2 out of bounds)

    Args:
        gained: length of the path covered in the step, in parts of what the top speed would drive.
        cross: distance from the path [m].
        linear: the action's linear part, in [-1, 1].
        outcome: number of the step's Outcome.
    """
    end = 2.0 if outcome == 1 else (-2.0 if outcome > 1 else 0.0)
    return 0.1 * gained - 0.02 - abs(cross) + 0.05 * min(linear, 0.0) + end
