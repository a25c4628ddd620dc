"""The dynamic window approach.

Fox, Burgard & Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics &
Automation Magazine 4 (1997).

Of the velocities that the robot can reach within a step, those are admissible after which it can
still stop before it touches anything. Among them the best is chosen by progress to the goal and
clearance. Progress is that along the way of the robot's map, as in the global dynamic window
approach (Brock & Khatib, ICRA 1999), because the heading towards the goal alone ends in the first
dead end. Arcs have the robot's acceleration limits and motor lag. Where the robot tracks movers,
the clearance of a pose is that from where they are by then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.sensors.map.way import length_left, next_corner
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.mapped import (
    MappedPolicy,
    Pose,
    points_clearance,
    polygon_distance,
)
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext

LINEAR_SAMPLES, ANGULAR_SAMPLES = 9, 25
"""How many linear and angular velocities of the window are tried."""
ARC_STEP = 0.05
"""Step of the predicted arcs [s]."""
STILL_STEPS, ALIGNED_BEARING = 5, 0.3
"""After so many decisions to stand still it turns to the way, up to this bearing [rad]."""
MotionState = tuple[float, float, float, float, float, float, float]
"""Pose (x, y, theta), twist, and last command (linear, angular) [m, rad, s]."""


@dataclass(frozen=True)
class DwaConstants:
    """Constants of the dynamic window approach; `constants.yaml` has those of the presets."""

    reverse_share: float = 0.4  # greatest speed backwards, out of dead ends [top speed]
    arc_time: float = 1.5  # how far ahead an arc is scored [s]
    turn_time: float = 0.6  # how long the robot turns on an arc before it goes straight [s]
    window_periods: float = 1.0  # velocities are tried that can be reached so soon [period]
    hold_periods: float = 2.0  # a velocity is kept so long before the robot brakes [period]
    nose: float = 1.0  # progress counts this far ahead, so that the heading matters [radius]
    stop_clearance: float = 0.125  # least clearance on the way to a stop [radius]
    near_cost: float = 0.3  # cost of a second without clearance [s at top speed]
    near_fade: float = 0.25  # clearance where that cost has fallen to 1/e [radius]
    blocked_cost: float = 0.6  # of an arc that comes too near, times what is left of it [s]


@dataclass(frozen=True)
class DwaMoversConstants(DwaConstants):
    """As `DwaConstants`; among movers it looks farther ahead, and tries more velocities."""

    arc_time: float = 2.5
    window_periods: float = 4.0
    blocked_cost: float = 4.0


class Surroundings(NamedTuple):
    """What predicted motions are scored by, in the odometry frame."""

    points: Floats
    """(n, 2): obstacles [m]."""
    sides: Floats
    """(sides, 4): of the footprint, in the base frame [m]."""
    outer: float
    """Radius of the disc around the footprint [m]."""
    way: Floats
    """(corners, 4): see `MapSensor.way_ahead`; the last one is the goal."""
    radius: float
    """Of the goal [m]."""
    movers: Floats
    """(m, 5): x, y [m], their rates [m/s], and radius [m]; they keep their velocities."""


class ArcModel(NamedTuple):
    """The robot and the constants on arcs, in SI units."""

    acceleration: float
    """Greatest linear acceleration [m/s^2], the angular one [rad/s^2], and the linear one of a full
    stop [m/s^2]."""
    spin: float
    braking: float
    blend: float
    """Share of the difference to the command by which the twist changes in a step."""
    arc_steps: int
    """Steps of an arc, of its turn, of holding a velocity, and until the robot stands at last."""
    turn_steps: int
    hold_steps: int
    stop_steps: int
    nose: float
    """[m]."""
    stop_clearance: float
    """[m]."""
    reach: float
    """Clearance from which more makes no difference [m]."""
    near_cost: float
    """[m/s]."""
    near_fade: float
    """[m]."""
    blocked_cost: float
    """[m]."""


class Dwa(MappedPolicy):
    """Samples the velocities that can be reached within a step, and keeps able to stop."""

    name = "dwa"
    constants_type = DwaConstants
    constants: DwaConstants
    _still = 0

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        units, k = self.units, self.constants
        hold = k.hold_periods * units.period
        self._model = ArcModel(
            acceleration=units.acceleration,
            spin=units.spin,
            braking=units.braking,
            blend=1.0 - math.exp(-ARC_STEP / units.lag) if units.lag > 0.0 else 1.0,
            arc_steps=units.steps(k.arc_time, ARC_STEP),
            turn_steps=units.steps(k.turn_time, ARC_STEP),
            hold_steps=units.steps(hold, ARC_STEP),
            stop_steps=units.steps(
                hold + units.speed / units.braking + 8.0 * units.lag + ARC_STEP, ARC_STEP
            ),
            nose=k.nose * units.radius,
            stop_clearance=k.stop_clearance * units.radius,
            reach=4.0 * k.near_fade * units.radius,
            near_cost=k.near_cost * units.speed,
            near_fade=k.near_fade * units.radius,
            blocked_cost=k.blocked_cost * units.speed,
        )

    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the best admissible velocity [m/s, rad/s]; stops where there is none."""
        config = self.setting.config
        window = self._window(config.max_linear, config.max_angular)
        ahead = config.max_linear * self.constants.arc_time + self._model.nose
        reach = ahead + self.outer + self._model.reach
        tracks = self.tracks()
        around = Surroundings(
            self.obstacles(pose, seen, reach, tracks),
            self.sides,
            self.outer,
            self.map.way_ahead,
            0.9 * self.setting.tolerance,
            tracks,
        )
        state = (*pose, seen.linear, seen.angular, *self.sent)
        scores = score_window(window, state, self._model, around)
        best = int(scores.argmin())
        if not math.isfinite(scores[best]):
            return self._escape(around, state)
        linear, angular = window[best].tolist()
        idle = abs(linear) < 0.06 * config.max_linear and abs(angular) < 0.1 * config.max_angular
        self._still = self._still + 1 if idle or self._still > STILL_STEPS else 0
        if self._still > STILL_STEPS:
            return self._align(pose, state, around) or (linear, angular)
        return linear, angular

    def reset(self) -> None:
        """Forget earlier decisions."""
        super().reset()
        self._still = 0

    def _align(
        self, pose: Pose, state: MotionState, around: Surroundings
    ) -> tuple[float, float] | None:
        """Turn towards the way, or back off where there is no room; None once it lies ahead."""
        x, y = self.carrot(pose, 1.7 * self.outer)
        bearing = math.atan2(y, x)
        if abs(bearing) < ALIGNED_BEARING:
            self._still = 0
            return None
        turn = math.copysign(0.5 * self.setting.config.max_angular, bearing)
        if can_stop(0.0, turn, state, self._model, around):
            return 0.0, turn
        return self._escape(around, state)

    def _window(self, fastest: float, turning: float) -> Floats:
        """(n, 2): velocities that can be reached soon, and standing still."""
        time = self.constants.window_periods * self.setting.period
        linear, angular = self._model.acceleration * time, self._model.spin * time
        v = self.sent[0] + np.linspace(-linear, linear, LINEAR_SAMPLES)
        v = np.clip(v, -self.constants.reverse_share * fastest, fastest)
        w = np.clip(
            self.sent[1] + np.linspace(-angular, angular, ANGULAR_SAMPLES), -turning, turning
        )
        pairs = np.stack(np.meshgrid(np.unique(np.append(v, 0.0)), np.unique(np.append(w, 0.0))))
        window: Floats = pairs.reshape(2, -1).T
        return window

    def _escape(self, around: Surroundings, state: MotionState) -> tuple[float, float]:
        """Back off slowly, or turn, to where there is more clearance; nothing is admissible."""
        (x, y, theta), units = state[:3], self.units
        best, chosen = -1.0, (0.0, 0.0)
        for linear in (0.0, -0.2 * units.speed, 0.2 * units.speed):
            for angular in (0.0, -0.4 * units.turning, 0.4 * units.turning):
                heading = theta + 0.3 * angular
                ahead = 0.3 * linear
                there = x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading
                free = pose_clearance(*there, around, self.outer)
                if free > best + 1e-3:
                    best, chosen = free, (linear, angular)
        return chosen


class DwaMovers(Dwa):
    """As `Dwa`, with arcs among movers that keep the velocities which the robot has estimated."""

    name = "dwa_movers"
    follows_movers = True
    constants_type = DwaMoversConstants


@jit
def advance_arc(
    state: MotionState, linear: float, angular: float, brake: float, spin: float, blend: float
) -> MotionState:
    """Predict the state an ARC_STEP later; `brake`, `spin` and `blend` as in `ArcModel`."""
    x, y, theta, v, w, sent_v, sent_w = state
    sent_v += min(max(linear - sent_v, -brake * ARC_STEP), brake * ARC_STEP)
    sent_w += min(max(angular - sent_w, -spin * ARC_STEP), spin * ARC_STEP)
    v += blend * (sent_v - v)
    w += blend * (sent_w - w)
    theta += w * ARC_STEP
    return (
        x + v * ARC_STEP * math.cos(theta),
        y + v * ARC_STEP * math.sin(theta),
        theta,
        v,
        w,
        sent_v,
        sent_w,
    )


@loop
def score_window(
    window: Floats, state: MotionState, model: ArcModel, around: Surroundings
) -> Floats:
    """Score velocities; less is better.

    Returns:
        (n,): the scores, in equivalent metres; infinite where a velocity isn't admissible.
    """
    scores = np.full(len(window), np.inf)
    for n in range(len(window)):
        if can_stop(window[n, 0], window[n, 1], state, model, around):
            scores[n] = score_velocity(window[n, 0], window[n, 1], state, model, around)
    return scores


@loop
def score_velocity(
    linear: float, angular: float, state: MotionState, model: ArcModel, around: Surroundings
) -> float:
    """Score of one admissible velocity."""
    cost, steps, spin, blend = 0.0, model.arc_steps, model.spin, model.blend
    for step in range(steps):
        turning = angular if step < model.turn_steps else 0.0
        state = advance_arc(state, linear, turning, model.acceleration, spin, blend)
        if step % 2 == 0:
            continue
        free = pose_clearance(state[0], state[1], state[2], around, model.reach)
        free = movers_clearance(state, (step + 1) * ARC_STEP, around, free)
        cost += 2.0 * ARC_STEP * model.near_cost * math.exp(-free / model.near_fade)
        left = 1.0 - step / steps
        if free < model.stop_clearance:
            cost += model.blocked_cost * left
            break
        if in_goal(state[0], state[1], around):
            return cost - left
    return cost + way_left(state, model.nose, around)


@loop
def can_stop(
    linear: float, angular: float, state: MotionState, model: ArcModel, around: Surroundings
) -> bool:
    """Whether the robot can obey a command for a while, and then stop without touching anything.

    Where it is too near to something already, coming no nearer is enough.
    """
    wanted, spin, blend = model.stop_clearance, model.spin, model.blend
    least = pose_clearance(state[0], state[1], state[2], around, wanted) - 1e-3
    for step in range(model.stop_steps):
        holding = step < model.hold_steps
        if holding:
            state = advance_arc(state, linear, angular, model.acceleration, spin, blend)
        else:
            state = advance_arc(state, 0.0, 0.0, model.braking, spin, blend)
        if pose_clearance(state[0], state[1], state[2], around, wanted) < least:
            return False
        if not holding and abs(state[3]) < 0.01 and abs(state[4]) < 0.05:
            break
    return True


@loop
def pose_clearance(x: float, y: float, theta: float, around: Surroundings, most: float) -> float:
    """Clearance of the footprint at a pose from what stands, at most `most` [m]."""
    return points_clearance(x, y, theta, around.points, around.sides, around.outer, most)


@loop
def movers_clearance(state: MotionState, time: float, around: Surroundings, most: float) -> float:
    """Clearance of the footprint from where movers are after some time, at most `most` [m]."""
    movers, cos, sin = around.movers, math.cos(state[2]), math.sin(state[2])
    for m in range(len(movers)):
        dx = movers[m, 0] + time * movers[m, 2] - state[0]
        dy = movers[m, 1] + time * movers[m, 3] - state[1]
        reach = around.outer + movers[m, 4] + most
        if dx * dx + dy * dy < reach * reach:
            gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, around.sides)
            most = min(most, max(gap - movers[m, 4], 0.0))
    return most


@jit
def in_goal(x: float, y: float, around: Surroundings) -> bool:
    """Whether a place is within the goal."""
    dx, dy = around.way[-1, 0] - x, around.way[-1, 1] - y
    inside: bool = dx * dx + dy * dy < around.radius * around.radius
    return inside


@loop
def way_left(state: MotionState, nose: float, around: Surroundings) -> float:
    """Length of the way that is left from `nose` ahead of a pose; so the heading matters [m]."""
    x, y = state[0] + nose * math.cos(state[2]), state[1] + nose * math.sin(state[2])
    corner = next_corner(around.way, 0, (x, y))
    return length_left(around.way, corner, (x, y))
