"""The ceiling: a search through space and time that knows where everybody will be."""

from __future__ import annotations

import copy
import math

import numpy as np

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy, Privileged
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext
from acsar_gym.worlds.time_search import HORIZON, TIME_STEP, search_time
from acsar_gym.worlds.world import World

REPLAN_TIME = 0.5
"""It searches anew so often [s]."""
MARGINS = (0.6, 0.3, 0.1, 0.0)
"""Margins around the disc of the robot that are tried, the widest first [radius]."""
SPEED_SHARE = 0.85
"""Speed of the path, so that the robot can catch up [top speed]."""
PREVIEW = 0.4
"""The robot drives to where the path is after this time [s]."""
TURN_GAIN = 4.0
"""Yaw rate for a bearing of 1 rad [1/s]."""
NEAR_SHARE = 0.1
"""Nearer to that place it stands [radius]."""


class TimeSearch(Privileged, BaselinePolicy):
    """Follows the path through space and time that arrives first, see `worlds.time_search`.

    People who react are predicted by a copy of theirs, among which the robot drives as it has
    planned before.
    """

    name = "time_search"
    needs = GOAL_NUMBERS

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self.reset()

    def reset(self) -> None:
        """Forget the last path."""
        self._path = np.zeros((0, 3))
        self._planned = -math.inf

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Drive to where the path is in a moment."""
        now, (x, y, theta) = self.env.robot.link.now(), self.truth.pose
        if now >= self._planned + REPLAN_TIME - 1e-6:
            self._path, self._planned = self._plan(seen, now), now
        to_x, to_y = place_on(self._path, now + PREVIEW)
        far, bearing = math.hypot(to_x - x, to_y - y), math.atan2(to_y - y, to_x - x) - theta
        if far < NEAR_SHARE * self.units.radius:
            return 0.0, 0.0
        bearing, direction = math.remainder(bearing, math.tau), 1.0
        if abs(bearing) > math.pi / 2.0:
            bearing, direction = math.remainder(bearing - math.pi, math.tau), -1.0
        speed = direction * far / PREVIEW * math.cos(bearing) ** 2
        return speed, TURN_GAIN * bearing

    def _plan(self, seen: DecodedObservation, now: float) -> Floats:
        """(points, 3): the path with the widest margin: time [s], x, y [m]; else the last one."""
        x, y, theta = self.truth.pose
        goal_x, goal_y = seen.goal
        cos, sin = math.cos(theta), math.sin(theta)
        goal = x + cos * goal_x - sin * goal_y, y + sin * goal_x + cos * goal_y
        assignment = self.env.episode.assignment
        world = assignment.world or World()
        for margin in MARGINS:
            path = search_time(
                world,
                (1.0 + margin) * self.units.radius,
                SPEED_SHARE * self.units.speed,
                (x, y),
                goal,
                begin=now,
                key=assignment.key,
                places=self._foresee(now),
                tolerance=0.8 * self.setting.tolerance,
            )
            if path is not None:
                return path
        return self._path if len(self._path) else np.array([[now, x, y]])

    def _foresee(self, now: float) -> Floats | None:
        """(steps, movers, 2): where people who react will be; None where nobody does."""
        world = self.env.episode.assignment.world
        if world is None or not any(mover.reacts for mover in world.movers):
            return None
        crowd = copy.deepcopy(self.truth.crowd)
        assert crowd is not None  # noqa: S101 - the world has movers
        path = self._path if len(self._path) else np.array([[now, *self.truth.pose[:2]]])
        period = self.setting.config.period
        every, places = round(TIME_STEP / period), [crowd.states[:, :2].copy()]
        for tick in range(1, round(HORIZON / period) + 1):
            x, y = place_on(path, now + tick * period)
            before = place_on(path, now + (tick - 1) * period)
            heading = math.atan2(y - before[1], x - before[0])
            speed = math.hypot(y - before[1], x - before[0]) / period
            crowd.advance((x, y, heading), (speed, 0.0))
            if tick % every == 0:
                places.append(crowd.states[:, :2].copy())
        return np.array(places)


def place_on(path: Floats, time: float) -> tuple[float, float]:
    """Where a path is at a time, its end at last [m]."""
    times = path[:, 0]
    return float(np.interp(time, times, path[:, 1])), float(np.interp(time, times, path[:, 2]))
