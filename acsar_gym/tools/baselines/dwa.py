"""The dynamic window approach.

Fox, Burgard & Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics &
Automation Magazine 4 (1997).

Of the velocities that the robot can reach within a step, those are admissible after which it can
still stop before it touches anything. Among them the best is chosen by progress to the goal and
clearance. Progress is that along the way of the robot's map, as in the global dynamic window
approach (Brock & Khatib, ICRA 1999), because the heading towards the goal alone ends in the first
dead end. Arcs have the robot's acceleration limits and motor lag. If the robot tracks movers, the
clearance of a pose is the distance from their places at that time.
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
    RADIUS,
    RATE_X,
    RATE_Y,
    MappedPolicy,
    Pose,
    X,
    Y,
    points_clearance,
    polygon_distance,
)
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext

LINEAR_SAMPLES = 9
ANGULAR_SAMPLES = 25
"""How many linear and angular velocities of the window are tried."""
ARC_STEP = 0.05
"""Step of the predicted arcs [s]."""
STILL_STEPS = 5
"""After more decisions to stay at rest the robot turns to the way."""
ALIGNED_BEARING = 0.3
"""It turns until the bearing of the way is smaller than this [rad]."""


class Motion(NamedTuple):
    """The motion of a robot in the odometry frame [m, rad, s]."""

    x: float
    y: float
    theta: float
    linear: float
    angular: float
    sent_linear: float
    """Last command."""
    sent_angular: float


@dataclass(frozen=True)
class DwaConstants:
    """Constants of the dynamic window approach. `constants.yaml` has those of the presets."""

    reverse_share: float = 0.4
    """Greatest speed backwards, out of dead ends [top speed]."""
    arc_time: float = 1.5
    """How far ahead an arc is scored [s]."""
    turn_time: float = 0.6
    """How long the robot turns on an arc before it goes straight [s]."""
    window_periods: float = 1.0
    """Velocities are tried that can be reached within this time [period]."""
    hold_periods: float = 2.0
    """How long a velocity is kept before the robot brakes [period]."""
    nose: float = 1.0
    """Progress counts this far ahead, so that the heading matters [radius]."""
    stop_clearance: float = 0.125
    """Least clearance on the way to a stop [radius]."""
    near_cost: float = 0.3
    """Cost of a second without clearance [s at top speed]."""
    near_fade: float = 0.25
    """Clearance at which that cost has fallen to 1/e [radius]."""
    blocked_cost: float = 0.6
    """Cost of an arc that comes too near, times its remaining share [s]."""


@dataclass(frozen=True)
class DwaMoversConstants(DwaConstants):
    """As `DwaConstants`. Among movers it looks farther ahead, and tries more velocities."""

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
    """(corners, 4): see `MapSensor.way_ahead`. The last one is the goal."""
    radius: float
    """Of the goal [m]."""
    movers: Floats
    """(m, 5): x, y [m], their rates [m/s], and radius [m]. They keep their velocities."""


class ArcModel(NamedTuple):
    """The robot and the constants on arcs, in SI units."""

    acceleration: float
    """Greatest linear [m/s^2] and angular acceleration [rad/s^2], and deceleration of a full stop
    [m/s^2]."""
    spin: float
    braking: float
    blend: float
    """Share of the difference to the command by which the twist changes in a step."""
    arc_steps: int
    """Steps of an arc, of its turn, of holding a velocity, and until the robot is at rest."""
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
        units = self.units
        k = self.constants
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
        """Choose the best admissible velocity [m/s, rad/s]. Stops if there is none."""
        config = self.setting.config
        window = self._window(config.max_linear, config.max_angular)
        ahead = config.max_linear * self.constants.arc_time + self._model.nose
        reach = ahead + self.outer + self._model.reach
        tracks = self.tracks()
        around = Surroundings(
            points=self.obstacles(pose, seen, reach, tracks),
            sides=self.sides,
            outer=self.outer,
            way=self.map.way_ahead,
            radius=0.9 * self.setting.tolerance,
            movers=tracks,
        )

        # The best velocity, unless none is admissible, or the robot is at rest.
        motion = Motion(*pose, seen.linear, seen.angular, *self.sent)
        scores = score_window(window, motion, self._model, around)
        best = int(scores.argmin())
        if not math.isfinite(scores[best]):
            return self._escape(around, motion)
        linear, angular = window[best].tolist()
        is_slow = abs(linear) < 0.06 * config.max_linear
        is_still = is_slow and abs(angular) < 0.1 * config.max_angular
        self._still = self._still + 1 if is_still or self._still > STILL_STEPS else 0
        if self._still > STILL_STEPS:
            return self._align(pose, motion, around) or (linear, angular)
        return linear, angular

    def reset(self) -> None:
        """Forget earlier decisions."""
        super().reset()
        self._still = 0

    def _align(
        self, pose: Pose, motion: Motion, around: Surroundings
    ) -> tuple[float, float] | None:
        """Turn towards the way, or back off if there is no room. None once it lies ahead."""
        x, y = self.carrot(pose, 1.7 * self.outer)
        bearing = math.atan2(y, x)
        if abs(bearing) < ALIGNED_BEARING:
            self._still = 0
            return None
        turn = math.copysign(0.5 * self.setting.config.max_angular, bearing)
        if can_stop(0.0, turn, motion, self._model, around):
            return 0.0, turn
        return self._escape(around, motion)

    def _window(self, fastest: float, turning: float) -> Floats:
        """(n, 2): velocities that can be reached soon, and standing still."""
        time = self.constants.window_periods * self.setting.period
        slowest = -self.constants.reverse_share * fastest
        linear = _sample(self.sent[0], self._model.acceleration * time, LINEAR_SAMPLES)
        angular = _sample(self.sent[1], self._model.spin * time, ANGULAR_SAMPLES)
        linear = np.unique(np.append(np.clip(linear, slowest, fastest), 0.0))
        angular = np.unique(np.append(np.clip(angular, -turning, turning), 0.0))
        window: Floats = np.stack(np.meshgrid(linear, angular)).reshape(2, -1).T
        return window

    def _escape(self, around: Surroundings, motion: Motion) -> tuple[float, float]:
        """Back off slowly, or turn, towards more clearance, because no velocity is admissible."""
        units = self.units
        most_free = -1.0
        chosen = (0.0, 0.0)
        for linear in (0.0, -0.2 * units.speed, 0.2 * units.speed):
            for angular in (0.0, -0.4 * units.turning, 0.4 * units.turning):
                heading = motion.theta + 0.3 * angular
                ahead = 0.3 * linear
                x = motion.x + ahead * math.cos(heading)
                y = motion.y + ahead * math.sin(heading)
                free = pose_clearance(x, y, heading, around, self.outer)
                if free > most_free + 1e-3:
                    most_free = free
                    chosen = (linear, angular)
        return chosen


def _sample(centre: float, reach: float, count: int) -> Floats:
    return centre + np.linspace(-reach, reach, count)


class DwaMovers(Dwa):
    """As `Dwa`, with arcs among movers that keep the velocities which the robot has estimated."""

    name = "dwa_movers"
    follows_movers = True
    constants_type = DwaMoversConstants


@jit
def advance_arc(
    motion: Motion, linear: float, angular: float, acceleration: float, model: ArcModel
) -> Motion:
    """Predict the motion an ARC_STEP later, with a linear acceleration [m/s^2]."""
    change = acceleration * ARC_STEP
    sent_linear = motion.sent_linear
    sent_linear += min(max(linear - sent_linear, -change), change)
    change = model.spin * ARC_STEP
    sent_angular = motion.sent_angular
    sent_angular += min(max(angular - sent_angular, -change), change)

    speed = motion.linear + model.blend * (sent_linear - motion.linear)
    turning = motion.angular + model.blend * (sent_angular - motion.angular)
    theta = motion.theta + turning * ARC_STEP
    return Motion(
        x=motion.x + speed * ARC_STEP * math.cos(theta),
        y=motion.y + speed * ARC_STEP * math.sin(theta),
        theta=theta,
        linear=speed,
        angular=turning,
        sent_linear=sent_linear,
        sent_angular=sent_angular,
    )


@loop
def score_window(window: Floats, motion: Motion, model: ArcModel, around: Surroundings) -> Floats:
    """Score velocities. Less is better.

    Returns:
        (n,): Scores in equivalent metres, infinite if a velocity isn't admissible.
    """
    scores = np.full(len(window), np.inf)
    for n in range(len(window)):
        if can_stop(window[n, 0], window[n, 1], motion, model, around):
            scores[n] = score_velocity(window[n, 0], window[n, 1], motion, model, around)
    return scores


@loop
def score_velocity(
    linear: float, angular: float, motion: Motion, model: ArcModel, around: Surroundings
) -> float:
    """Score an admissible velocity."""
    cost = 0.0
    for step in range(model.arc_steps):
        turning = angular if step < model.turn_steps else 0.0
        motion = advance_arc(motion, linear, turning, model.acceleration, model)
        if step % 2 == 0:
            continue

        free = pose_clearance(motion.x, motion.y, motion.theta, around, model.reach)
        free = movers_clearance(motion, (step + 1) * ARC_STEP, around, free)
        cost += 2.0 * ARC_STEP * model.near_cost * math.exp(-free / model.near_fade)
        remaining = 1.0 - step / model.arc_steps
        if free < model.stop_clearance:
            cost += model.blocked_cost * remaining
            break
        if in_goal(motion.x, motion.y, around):
            return cost - remaining
    return cost + way_left(motion, model.nose, around)


@loop
def can_stop(
    linear: float, angular: float, motion: Motion, model: ArcModel, around: Surroundings
) -> bool:
    """Whether the robot can obey a command for a while, and then stop without touching anything.

    If it is too near to something already, coming no nearer is enough.
    """
    wanted = model.stop_clearance
    enough = pose_clearance(motion.x, motion.y, motion.theta, around, wanted) - 1e-3
    for step in range(model.stop_steps):
        is_holding = step < model.hold_steps
        if is_holding:
            motion = advance_arc(motion, linear, angular, model.acceleration, model)
        else:
            motion = advance_arc(motion, 0.0, 0.0, model.braking, model)
        if pose_clearance(motion.x, motion.y, motion.theta, around, wanted) < enough:
            return False
        if not is_holding and abs(motion.linear) < 0.01 and abs(motion.angular) < 0.05:
            break
    return True


@loop
def pose_clearance(x: float, y: float, theta: float, around: Surroundings, limit: float) -> float:
    """Clearance of the footprint at a pose from obstacles, at most `limit` [m]."""
    return points_clearance((x, y, theta), around.points, around.sides, around.outer, limit)


@loop
def movers_clearance(motion: Motion, time: float, around: Surroundings, limit: float) -> float:
    """Clearance of the footprint from where movers are after some time, at most `limit` [m]."""
    movers = around.movers
    cos = math.cos(motion.theta)
    sin = math.sin(motion.theta)
    for m in range(len(movers)):
        dx = movers[m, X] + time * movers[m, RATE_X] - motion.x
        dy = movers[m, Y] + time * movers[m, RATE_Y] - motion.y
        reach = around.outer + movers[m, RADIUS] + limit
        if dx * dx + dy * dy < reach * reach:
            gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, around.sides)
            limit = min(limit, max(gap - movers[m, RADIUS], 0.0))
    return limit


@jit
def in_goal(x: float, y: float, around: Surroundings) -> bool:
    """Whether a place is within the goal."""
    dx = around.way[-1, 0] - x
    dy = around.way[-1, 1] - y
    is_inside: bool = dx * dx + dy * dy < around.radius * around.radius
    return is_inside


@loop
def way_left(motion: Motion, nose: float, around: Surroundings) -> float:
    """Length of the way that remains from `nose` ahead of a pose, so the heading matters [m]."""
    x = motion.x + nose * math.cos(motion.theta)
    y = motion.y + nose * math.sin(motion.theta)
    corner = next_corner(around.way, 0, (x, y))
    return length_left(around.way, corner, (x, y))
