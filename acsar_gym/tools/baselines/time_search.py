"""The ceilings: a search through space and time that knows where everybody will be, or is."""

from __future__ import annotations

import copy
import math
from typing import ClassVar

import gymnasium
import numpy as np

from acsar_gym.envs.ids import strip_module
from acsar_gym.jit import jit, loop
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy, Privileged
from acsar_gym.tools.baselines.dwa import ARC_STEP, MotionState, advance_arc
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext
from acsar_gym.worlds.geometry import distance_to_line
from acsar_gym.worlds.time_search import HORIZON, TIME_STEP, search_time
from acsar_gym.worlds.world import World

REPLAN_TIME, LEFT_PATH = 0.3, 0.4
"""It searches anew so often [s] where people react, or it is so far from its path [radius]."""
TRUST_TIME = 4.0
"""So long velocities of now count as kept; then nobody is in the way any more [s]."""
NOWHERE = 1e4
"""Place of those who aren't in the way [m]."""
WIDEN_TIME = 2.0
"""It looks so often for a path with a wider margin [s]."""
MARGINS = ((0.4, 0.4), (0.2, 0.4), (0.1, 0.2), (0.05, 0.1), (0.0, 0.0))
"""Margins around the disc of the robot from all, and beside them from movers, that are tried, the
widest first [radius]."""
SPEED_SHARE, MOST_SPEED = 0.8, 0.8
"""Speed of the path, so that the robot can turn and catch up: a part of its top speed, and the most
[m/s]."""
CATCH_UP = 1.25
"""It drives faster than the path by this factor at most, where it is late."""
MOST_TURNING = 2.0
"""Its greatest yaw rate [rad/s]."""
TRACK_STEPS = 16
"""Arcs that follow the path are compared over so many steps of ARC_STEP."""
MOST_SIDEWAYS = 1.0
"""Arcs have less acceleration sideways, where tyres would slide and odometry drift [m/s^2]."""
TURN_COST = 1e-6
"""So it stands still where it waits [m^2 s^2]."""
LINEAR_SAMPLES, ANGULAR_SAMPLES = 21, 31
"""How many linear and angular velocities are tried."""


class TimeSearch(Privileged, BaselinePolicy):
    """Follows the path through space and time that arrives first, see `worlds.time_search`.

    People who react are predicted by a copy of theirs, among which the robot drives as it has
    planned before.
    """

    name = "time_search"
    needs = GOAL_NUMBERS
    replan_time: ClassVar[float] = REPLAN_TIME

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self._speed = min(SPEED_SHARE * self.units.speed, MOST_SPEED)
        steps = gymnasium.spec(strip_module(self.env_id)).max_episode_steps
        self._last = math.inf if steps is None else (steps - 1) * setting.period
        self.reset()

    def reset(self) -> None:
        """Forget the last path."""
        self._path = np.zeros((0, 3))
        self._planned, self._margin = -math.inf, len(MARGINS)
        self._sent = (0.0, 0.0)

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the arc that comes nearest to the path."""
        units, now = self.units, self.env.robot.link.now()
        self._plan(seen, now)
        times = now + ARC_STEP * np.arange(1, TRACK_STEPS + 1)
        line = np.column_stack([np.interp(times, *self._path.T[[0, n]]) for n in (1, 2)])
        state = (*self.truth.pose, seen.linear, seen.angular, *self._sent)
        blend = 1.0 - math.exp(-ARC_STEP / units.lag) if units.lag > 0.0 else 1.0
        limits = (
            min(CATCH_UP * self._speed, units.speed),
            min(MOST_TURNING, units.turning),
            units.acceleration,
            units.spin,
            blend,
        )
        world = self.env.episode.assignment.world or World()
        self._sent = choose_arc(
            state, line, limits, world.circles, world.segments, 1.05 * units.radius
        )
        return self._sent

    def _plan(self, seen: DecodedObservation, now: float) -> None:
        """Search where the path doesn't do any more, or a wider margin may have become possible."""
        x, y, theta = self.truth.pose
        goal_x, goal_y = seen.goal
        cos, sin = math.cos(theta), math.sin(theta)
        goal = x + cos * goal_x - sin * goal_y, y + sin * goal_x + cos * goal_y
        assignment = self.env.episode.assignment
        world = assignment.world or World()
        is_bad = (
            not len(self._path)
            or self._may_err()
            or math.dist((x, y), place_on(self._path, now)) > LEFT_PATH * self.units.radius
            or math.dist(self._path[-1, 1:], goal) > self.setting.tolerance
        )
        if now - self._planned + 1e-6 < (self.replan_time if is_bad else WIDEN_TIME):
            return
        places, self._planned = self._foresee(now), now
        for number, (margin, mover_margin) in enumerate(MARGINS):
            if not is_bad and number >= self._margin:
                return
            path = search_time(
                world,
                (1.0 + margin) * self.units.radius,
                self._speed,
                (x, y),
                goal,
                margin=mover_margin * self.units.radius,
                begin=now,
                key=assignment.key,
                places=places,
                horizon=min(HORIZON, self._last - now),
                tolerance=0.8 * self.setting.tolerance,
            )
            if path is not None:
                self._path, self._margin = path, number
                return
        if not len(self._path):
            self._path = np.array([[now, x, y]])

    def _may_err(self) -> bool:
        """Whether somebody may be elsewhere than foreseen."""
        world = self.env.episode.assignment.world
        return world is not None and any(mover.reacts for mover in world.movers)

    def _foresee(self, now: float) -> Floats | None:
        """(steps, movers, 2): where people who react will be; None where nobody does."""
        if not self._may_err():
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


class SearchTrue(TimeSearch):
    """As `TimeSearch`, from the true places and velocities of now, which it supposes are kept.

    It says how far a robot comes that sees everything, plans with it at every step, and doesn't
    know what people will do.
    """

    name = "search_true"
    replan_time = 0.0

    def _may_err(self) -> bool:
        return True

    def _foresee(self, now: float) -> Floats | None:
        """(steps, movers, 2): where all will be if they keep their velocities."""
        if self.truth.crowd is None:
            return None
        states = self.truth.crowd.states
        places = np.full((round(HORIZON / TIME_STEP) + 1, len(states), 2), NOWHERE)
        known = round(TRUST_TIME / TIME_STEP) + 1
        times = TIME_STEP * np.arange(known)[:, None, None]
        places[:known] = states[:, :2] + times * states[:, 2:4]
        return places


def place_on(path: Floats, time: float) -> tuple[float, float]:
    """Where a path is at a time, its end at last [m]."""
    times = path[:, 0]
    return float(np.interp(time, times, path[:, 1])), float(np.interp(time, times, path[:, 2]))


@loop
def choose_arc(
    state: MotionState,
    line: Floats,
    limits: tuple[float, float, float, float, float],
    circles: Floats,
    segments: Floats,
    clearance: float,
) -> tuple[float, float]:
    """Choose the velocity command whose arc is nearest to a line, (steps, 2) [m].

    An arc that comes nearer to what stands than `clearance`, and nearer than it is, isn't chosen.

    `limits` are top speed [m/s], greatest yaw rate [rad/s], acceleration [m/s^2], angular
    acceleration [rad/s^2], and `ArcModel.blend`.
    """
    speed, turning, acceleration, spin, blend = limits
    best, linear, angular, least = np.inf, 0.0, 0.0, clearance
    while is_blocked(state[0], state[1], circles, segments, least):
        least -= 0.01
    for i in range(LINEAR_SAMPLES):
        v = speed * (2.0 * i / (LINEAR_SAMPLES - 1) - 1.0)
        for j in range(ANGULAR_SAMPLES):
            w = turning * (2.0 * j / (ANGULAR_SAMPLES - 1) - 1.0)
            if abs(v * w) > MOST_SIDEWAYS:
                continue
            cost, there = TURN_COST * w * w, state
            for step in range(len(line)):
                there = advance_arc(there, v, w, acceleration, spin, blend)
                dx, dy = there[0] - line[step, 0], there[1] - line[step, 1]
                cost += dx * dx + dy * dy
                if cost >= best or is_blocked(there[0], there[1], circles, segments, least):
                    cost = np.inf
                    break
            if cost < best:
                best, linear, angular = cost, v, w
    return linear, angular


@jit
def is_blocked(x: float, y: float, circles: Floats, segments: Floats, reach: float) -> bool:
    """Whether a circle or a segment is nearer to a place than `reach` [m]."""
    for n in range(len(circles)):
        dx, dy, far = x - circles[n, 0], y - circles[n, 1], reach + circles[n, 2]
        if dx * dx + dy * dy < far * far and far > 0.0:
            return True
    for n in range(len(segments)):
        line = segments[n]
        if distance_to_line(x, y, line[0], line[1], line[2], line[3]) < reach:
            return True
    return False
