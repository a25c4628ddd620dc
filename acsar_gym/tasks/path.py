"""Follow a path by odometry: where the robot is beside it, and where the path goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop
from acsar_gym.tasks import spawn as place
from acsar_gym.tasks.base import (
    OBSERVATION_LIMIT,
    Assignment,
    Info,
    Outcome,
    State,
    clipped,
    known,
    positive,
    relative,
    world_info,
)
from acsar_gym.worlds import Pose
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.world import Floats

PATH_LAYOUT = (
    "cross_track_error",
    "heading_cos",
    "heading_sin",
    "remaining",
    *(f"{axis}_{number}" for number in range(1, 5) for axis in ("ahead", "left")),
    "linear_velocity",
    "angular_velocity",
    "last_linear",
    "last_angular",
)
LOOKAHEAD = 4
"""Points of the path ahead that the robot sees."""
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


@dataclass(frozen=True)
class PathFollow:
    """Follow a smooth path, or straight pieces between waypoints."""

    max_cross_track: float
    """An episode ends without success this far beside the path; also scales what is seen [m]."""
    max_linear: float
    max_angular: float
    pool: Pool
    id = "acsar_gym/PathFollow-v0"
    sees = False
    layout = PATH_LAYOUT

    @classmethod
    def of(cls, pool: Pool, max_cross_track: float, config: RobotConfig) -> PathFollow:
        """From an env's arguments. Raises ConfigError for a bad distance."""
        most = positive("max_cross_track", max_cross_track)
        return cls(most, config.max_linear, config.max_angular, pool)

    def low(self) -> tuple[float, ...]:
        """Least value of each of the observation's numbers."""
        low = [-high for high in self.high()]
        low[3] = 0.0
        return tuple(low)

    def high(self) -> tuple[float, ...]:
        """Largest value of each of them."""
        limit = OBSERVATION_LIMIT
        return (limit, 1.0, 1.0, limit, *(limit,) * (2 * LOOKAHEAD), limit, limit, 1.0, 1.0)

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any]) -> PathCourse:
        """A path of the pool; options "world", "difficulty", or "path": points (x, y) [m]."""
        options = known(options, ("world", "difficulty", "path"))
        if options.get("path") is not None:
            return PathCourse(self, place.given(options["path"]))
        return PathCourse(self, place.drawn(self.pool, rng, options, follow=True))


class PathCourse:
    """An episode: it remembers the progress along the path, and adds up the errors."""

    tolerance = TOLERANCE

    def __init__(self, task: PathFollow, assignment: Assignment) -> None:
        self.assignment = assignment
        self._task = task
        self._path = np.zeros((2, 3)) if assignment.path is None else assignment.path
        self._last = len(self._path) - 1
        self._spacing = assignment.length / self._last
        self._place, self._cross, self._bearing = nearest(self._path, self._last, 0.0, 0.0, 0.0)
        self._sums, self._steps = (0.0, 0.0), 0

    def judge(self, state: State) -> tuple[float, Outcome]:
        """Success near the path's end, out of bounds too far beside it."""
        x, y, theta = state.pose
        before = self._place
        self._place, self._cross, self._bearing = nearest(self._path, self._last, before, x, y)
        heading = heading_error(theta, self._bearing)
        self._sums = (self._sums[0] + abs(self._cross), self._sums[1] + abs(heading))
        self._steps += 1
        end_x, end_y = self.assignment.goal
        remaining = (self._last - self._place) * self._spacing
        far = math.sqrt((end_x - x) ** 2 + (end_y - y) ** 2)
        number = path_outcome(remaining, far, abs(self._cross), self._task.max_cross_track)
        gain = (self._place - before) * self._spacing
        return path_reward(gain, self._cross, state.action[0], number), Outcome(number)

    def observe(self, state: State) -> tuple[float, ...]:
        """As PATH_LAYOUT; lengths and speeds scaled."""
        (x, y, theta), task = state.pose, self._task
        heading = heading_error(theta, self._bearing)
        cos, sin = math.cos(theta), math.sin(theta)
        seen: list[float] = []
        for number in range(1, LOOKAHEAD + 1):
            k = min(int(self._place) + number * STRIDE, self._last)
            px, py = self._path[k, 0], self._path[k, 1]
            ahead, left = relative(x, y, cos, sin, px, py)
            seen += [clipped(ahead, OBSERVATION_LIMIT), clipped(left, OBSERVATION_LIMIT)]
        remaining = (self._last - self._place) * self._spacing / LENGTH_SCALE
        return (
            clipped(self._cross / task.max_cross_track, OBSERVATION_LIMIT),
            math.cos(heading),
            math.sin(heading),
            min(remaining, OBSERVATION_LIMIT),
            *seen,
            clipped(state.twist[0] / task.max_linear, OBSERVATION_LIMIT),
            clipped(state.twist[1] / task.max_angular, OBSERVATION_LIMIT),
            *state.action,
        )

    def info(self, state: State, truth: Pose) -> Info:
        """Errors now and their means over the steps so far, and the share of the path done."""
        steps = max(self._steps, 1)
        return {
            "cross_track_error": self._cross,
            "heading_error": heading_error(state.pose[2], self._bearing),
            "path_progress": self._place / self._last,
            "mean_cross_track_error": self._sums[0] / steps,
            "mean_heading_error": self._sums[1] / steps,
        } | world_info(self.assignment)


# The functions below are compiled for whole batches of robots, too.


@loop
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


@jit
def heading_error(theta: float, bearing: float) -> float:
    """Heading against the path's direction [rad], within -pi to pi; positive to the left."""
    error = theta - bearing
    return error - 2.0 * math.pi * math.floor(error / (2.0 * math.pi) + 0.5)


@jit
def path_outcome(remaining: float, far: float, beside: float, most: float) -> int:
    """The Outcome's number: success near the end [m] both along the path and straight."""
    if remaining <= TOLERANCE and far <= TOLERANCE:
        return 1
    return 2 if beside > most else 0


@jit
def path_reward(gain: float, cross: float, linear: float, outcome: int) -> float:
    """Twice the metres gained along the path, less 0.02 and 0.5 a metre beside it, a step.

    Less up to 0.05 for driving backwards; plus 2 at the end, or -2 out of bounds.
    """
    end = 2.0 if outcome == 1 else (-2.0 if outcome > 1 else 0.0)
    return 2.0 * gain - 0.02 - 0.5 * abs(cross) + 0.05 * min(linear, 0.0) + end
