"""Follow a path by odometry: where the robot is beside it, and where the path goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.dynamics.trigonometry import direction
from acsar_gym.jit import compilable
from acsar_gym.tasks.base import (
    OBSERVATION_LIMIT,
    Floats,
    Outcome,
    State,
    Task,
    clipped,
    relative,
)
from acsar_gym.tasks.options import positive

_SCALED = (-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
LOOKAHEAD = 4
"""Points of the path ahead that the robot sees."""
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
}
STRIDE = 5
"""Samples of the path between two of them: 0.25 m."""
BACK, AHEAD = 10, 20
"""Samples of the path that are searched behind and ahead of the last progress."""
TIE = 1e-12
"""Squared distances this near count as equal, as beside a corner: the first piece counts [m^2]."""
LENGTH_SCALE = 10.0
"""Scales the length that remains [m]."""
TOLERANCE = 0.15
"""An odometry position this close to the end of the path is a success [m]."""


@dataclass(frozen=True, kw_only=True)
class PathFollow(Task):
    """Follow a smooth path, or straight pieces between waypoints."""

    max_cross_track: float = 0.5
    """An episode ends without success this far beside the path; also scales what is seen [m]."""
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
    goal_tolerance = TOLERANCE
    follows = True
    compiled = True

    def __post_init__(self) -> None:
        most = positive("max_cross_track", self.max_cross_track)
        object.__setattr__(self, "max_cross_track", most)

    def begin(self, state: State, memory: Any) -> None:
        """Find the robot's place at the path's beginning."""
        locate(state, memory)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success near the path's end, out of bounds too far beside it."""
        locate(state, memory)
        steps = math.floor(state.time / state.period + 0.5)
        memory.cross_sum += abs(memory.cross_track_error)
        memory.heading_sum += abs(memory.heading_error)
        memory.mean_cross_track_error = memory.cross_sum / steps
        memory.mean_heading_error = memory.heading_sum / steps
        x, y, _ = state.pose
        far = math.sqrt((state.goal[0] - x) ** 2 + (state.goal[1] - y) ** 2)
        return path_outcome(  # type: ignore[return-value]  # its number
            remaining(state, memory), far, abs(memory.cross_track_error), self.max_cross_track
        )

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """See `path_reward`."""
        gain, cross = memory.gain, memory.cross_track_error
        return path_reward(gain, cross, state.action[0], outcome)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """As PATH_OBSERVATION; lengths and speeds scaled."""
        limit, (cos, sin) = OBSERVATION_LIMIT, direction(state.pose[2])
        return (
            clipped(memory.cross_track_error / self.max_cross_track, limit),
            *direction(memory.heading_error),
            min(remaining(state, memory) / LENGTH_SCALE, limit),
            *point_ahead(state, memory, cos, sin, 1),
            *point_ahead(state, memory, cos, sin, 2),
            *point_ahead(state, memory, cos, sin, 3),
            *point_ahead(state, memory, cos, sin, 4),
            clipped(state.twist[0] / state.max_twist[0], limit),
            clipped(state.twist[1] / state.max_twist[1], limit),
            *state.action,
        )


@compilable
def locate(state: State, memory: Any) -> None:
    """Note where the robot is on its path, from where it was before."""
    x, y, theta = state.pose
    last, before = len(state.path) - 1, memory.progress
    progress, cross, bearing = nearest(state.path, last, before, x, y)
    memory.progress, memory.bearing = progress, bearing
    memory.gain = (progress - before) * (state.length / last)
    memory.cross_track_error = cross
    memory.heading_error = heading_error(theta, bearing)
    memory.path_progress = progress / last


@compilable
def remaining(state: State, memory: Any) -> float:
    """Length of the path that the robot hasn't driven yet [m]."""
    last = len(state.path) - 1
    length: float = (last - memory.progress) * (state.length / last)
    return length


@compilable
def point_ahead(
    state: State, memory: Any, cos: float, sin: float, number: int
) -> tuple[float, float]:
    """A point of the path as the robot sees it: ahead and left [m], bounded.

    `cos` and `sin` are those of the robot's heading.
    """
    k = min(int(memory.progress) + number * STRIDE, len(state.path) - 1)
    x, y = state.path[k, 0], state.path[k, 1]
    ahead, left = relative(state.pose[0], state.pose[1], cos, sin, x, y)
    return clipped(ahead, OBSERVATION_LIMIT), clipped(left, OBSERVATION_LIMIT)


@compilable
def nearest(
    path: Floats, last: int, progress: float, x: float, y: float
) -> tuple[float, float, float]:
    """Where on the path the point is: progress [samples], distance beside it, and its direction.

    Of the path's pieces near the last progress, the nearest counts. The distance [m] is positive to
    the left of the path; before its first and behind its last sample it is that to the sample.
    """
    first = max(int(progress) - BACK, 0)
    best, place, side, bearing = math.inf, progress, 0.0, 0.0
    for k in range(first, min(int(progress) + AHEAD, last)):
        ex, ey = path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1]
        dx, dy = x - path[k, 0], y - path[k, 1]
        share = (dx * ex + dy * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        rx, ry = dx - share * ex, dy - share * ey
        square = rx * rx + ry * ry
        if square < best - TIE:
            best, place, bearing = square, k + share, path[k, 2]
            side = 1.0 if ex * dy - ey * dx >= 0.0 else -1.0
    return place, side * math.sqrt(best), bearing


@compilable
def heading_error(theta: float, bearing: float) -> float:
    """Heading against the path's direction [rad], within -pi to pi; positive to the left."""
    error = theta - bearing
    return error - 2.0 * math.pi * math.floor(error / (2.0 * math.pi) + 0.5)


@compilable
def path_outcome(remaining: float, far: float, beside: float, most: float) -> int:
    """The Outcome's number: success near the end [m] both along the path and straight."""
    if remaining <= TOLERANCE and far <= TOLERANCE:
        return 1
    return 2 if beside > most else 0


@compilable
def path_reward(gain: float, cross: float, linear: float, outcome: int) -> float:
    """Twice the metres gained along the path, less 0.02 and 0.5 a metre beside it, a step.

    Less up to 0.05 for driving backwards; plus 2 at the end, or -2 out of bounds.
    """
    end = 2.0 if outcome == 1 else (-2.0 if outcome > 1 else 0.0)
    return 2.0 * gain - 0.02 - 0.5 * abs(cross) + 0.05 * min(linear, 0.0) + end
