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
from typing import NamedTuple

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.sensors.map.way import length_left, next_corner
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import Periods, Radii, RobotUnits, Speeds
from acsar_gym.tools.baselines.mapped import (
    RADIUS,
    RATE_X,
    RATE_Y,
    Footprint,
    MappedPolicy,
    Pose,
    X,
    Y,
    blend_of,
    footprint_clearance,
    polygon_distance,
)
from acsar_gym.tools.policies.policy import DecodedObservation

LINEAR_SAMPLES = 9
ANGULAR_SAMPLES = 25
"""How many linear and angular velocities of the window are tried."""
ARC_STEP = 0.05
"""Step of the predicted arcs [s]."""
STILL_STEPS = 5
"""After more decisions to stay at rest the robot turns to the way."""
FADED = 4.0
"""Clearances from this multiple of `near_fade` on make no difference."""
ALIGNED_BEARING = 0.3
"""It turns until the bearing of the way is smaller than this [rad]."""


class Motion(NamedTuple):
    """The motion of a robot in the odometry frame [m, rad, s]."""

    pose: Pose
    linear: float
    angular: float
    sent_linear: float
    """Last command."""
    sent_angular: float


class DwaConstants(NamedTuple):
    """Constants of the dynamic window approach. `constants.yaml` has those of the presets."""

    reverse_share: Speeds = 0.4
    """Greatest speed backwards, out of dead ends [top speed]."""
    arc_time: float = 1.5
    """How far ahead an arc is scored [s]."""
    turn_time: float = 0.6
    """How long the robot turns on an arc before it goes straight [s]."""
    window_periods: Periods = 1.0
    """Velocities are tried that can be reached within this time [period]."""
    hold_periods: Periods = 2.0
    """How long a velocity is kept before the robot brakes [period]."""
    nose: Radii = 1.0
    """Progress counts this far ahead, so that the heading matters [radius]."""
    stop_clearance: Radii = 0.125
    """Least clearance on the way to a stop [radius]."""
    near_cost: Speeds = 0.3
    """Cost of a second without clearance [s at top speed]."""
    near_fade: Radii = 0.25
    """Clearance at which that cost has fallen to 1/e [radius]."""
    blocked_cost: Speeds = 0.6
    """Cost of an arc that comes too near, times its remaining share [s]."""


class Situation(NamedTuple):
    """What predicted motions are scored by: robot, constants, and what is around it."""

    k: DwaConstants
    """The constants in SI units."""
    units: RobotUnits
    blend: float
    """Share of the difference to the command by which the twist changes in an ARC_STEP."""
    footprint: Footprint
    points: Floats
    """(n, 2): obstacles in the odometry frame [m]."""
    movers: Floats
    """(m, 5): tracks of movers, which keep their velocities."""
    way: Floats
    """(corners, 4): see `MapSensor.way_ahead`. The last one is the goal."""
    goal_radius: float
    """[m]."""


class Dwa(MappedPolicy):
    """Samples the velocities that can be reached within a step, and keeps able to stop."""

    name = "dwa"
    constants = DwaConstants()
    _still = 0

    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the best admissible velocity [m/s, rad/s]. Stops if there is none."""
        units = self.units
        k = self.constants
        ahead = units.speed * k.arc_time + k.nose
        around = Situation(
            k,
            units,
            blend_of(ARC_STEP, units.lag),
            self.footprint,
            points=self.obstacles(pose, seen, ahead + units.radius + FADED * k.near_fade),
            movers=self.tracks(),
            way=self.map.way_ahead,
            goal_radius=0.9 * self.setting.tolerance,
        )

        # The best velocity, unless none is admissible.
        motion = Motion(pose, seen.linear, seen.angular, *self.sent)
        window = self._window()
        scores = score_window(window, motion, around)
        best = int(scores.argmin())
        if not math.isfinite(scores[best]):
            return escape(motion, around)

        # A robot that barely moves is stuck, if that lasts.
        linear, angular = window[best].tolist()
        is_slow = abs(linear) < 0.06 * units.speed
        is_still = is_slow and abs(angular) < 0.1 * units.turning
        self._still = self._still + 1 if is_still or self._still > STILL_STEPS else 0
        if self._still <= STILL_STEPS:
            return linear, angular

        # After a while at rest, turn towards the way, or back off if there is no room.
        x, y = self.carrot(pose, 1.7 * units.radius)
        bearing = math.atan2(y, x)
        if abs(bearing) < ALIGNED_BEARING:
            self._still = 0
            return linear, angular
        turn = math.copysign(0.5 * units.turning, bearing)
        return (0.0, turn) if can_stop(0.0, turn, motion, around) else escape(motion, around)

    def reset(self) -> None:
        """Forget earlier decisions."""
        super().reset()
        self._still = 0

    def _window(self) -> Floats:
        """(n, 2): velocities that can be reached soon, and standing still."""
        # Standing still is always tried, so that the robot can wait.
        k = self.constants
        units = self.units
        reach = units.acceleration * k.window_periods
        linear = self.sent[0] + np.linspace(-reach, reach, LINEAR_SAMPLES)
        linear = np.unique(np.append(np.clip(linear, -k.reverse_share, units.speed), 0.0))
        reach = units.spin * k.window_periods
        angular = self.sent[1] + np.linspace(-reach, reach, ANGULAR_SAMPLES)
        angular = np.unique(np.append(np.clip(angular, -units.turning, units.turning), 0.0))
        window: Floats = np.stack(np.meshgrid(linear, angular)).reshape(2, -1).T
        return window


class DwaMovers(Dwa):
    """As `Dwa`, with arcs among movers that keep the velocities which the robot has estimated.

    Among movers it looks farther ahead, and tries more velocities.
    """

    name = "dwa_movers"
    follows_movers = True
    constants = DwaConstants(arc_time=2.5, window_periods=4.0, blocked_cost=4.0)


@jit
def count_steps(seconds: float) -> int:
    """Number of ARC_STEPs that are nearest to a duration [s], at least 1."""
    return max(1, math.floor(seconds / ARC_STEP + 0.5))


@jit
def advance_arc(
    motion: Motion, linear: float, angular: float, acceleration: float, around: Situation
) -> Motion:
    """Predict the motion an ARC_STEP later, with a linear acceleration [m/s^2]."""
    # The command limits of the driver.
    change = acceleration * ARC_STEP
    sent_linear = motion.sent_linear
    sent_linear += min(max(linear - sent_linear, -change), change)
    change = around.units.spin * ARC_STEP
    sent_angular = motion.sent_angular
    sent_angular += min(max(angular - sent_angular, -change), change)

    # The lag of the motors, then the odometry.
    speed = motion.linear + around.blend * (sent_linear - motion.linear)
    turning = motion.angular + around.blend * (sent_angular - motion.angular)
    x, y, theta = motion.pose
    theta += turning * ARC_STEP
    x += speed * ARC_STEP * math.cos(theta)
    y += speed * ARC_STEP * math.sin(theta)
    return Motion(
        pose=(x, y, theta),
        linear=speed,
        angular=turning,
        sent_linear=sent_linear,
        sent_angular=sent_angular,
    )


@loop
def score_window(window: Floats, motion: Motion, around: Situation) -> Floats:
    """Score velocities. Less is better.

    Returns:
        (n,): Scores in equivalent metres, infinite if a velocity isn't admissible.
    """
    scores = np.full(len(window), np.inf)
    for n in range(len(window)):
        if can_stop(window[n, 0], window[n, 1], motion, around):
            scores[n] = score_velocity(window[n, 0], window[n, 1], motion, around)
    return scores


@loop
def score_velocity(linear: float, angular: float, motion: Motion, around: Situation) -> float:
    """Score an admissible velocity."""
    k = around.k
    arc_steps = count_steps(k.arc_time)
    turn_steps = count_steps(k.turn_time)
    cost = 0.0
    for step in range(arc_steps):
        turning = angular if step < turn_steps else 0.0
        motion = advance_arc(motion, linear, turning, around.units.acceleration, around)
        if step % 2 == 0:  # every second step is near enough to the next
            continue

        # Nearness costs, and contact ends the arc.
        free = pose_clearance(motion.pose, around, FADED * k.near_fade)
        free = movers_clearance(motion, (step + 1) * ARC_STEP, around, free)
        cost += 2.0 * ARC_STEP * k.near_cost * math.exp(-free / k.near_fade)
        remaining = 1.0 - step / arc_steps
        if free < k.stop_clearance:
            cost += k.blocked_cost * remaining
            break

        # The goal ends it as well.
        dx = around.way[-1, X] - motion.pose[X]
        dy = around.way[-1, Y] - motion.pose[Y]
        if dx * dx + dy * dy < around.goal_radius * around.goal_radius:
            return cost - remaining

    # The way that remains from the nose, so that the heading matters.
    x, y, theta = motion.pose
    nose = (x + k.nose * math.cos(theta), y + k.nose * math.sin(theta))
    return cost + length_left(around.way, next_corner(around.way, 0, nose), nose)


@loop
def can_stop(linear: float, angular: float, motion: Motion, around: Situation) -> bool:
    """Whether the robot can obey a command for a while, and then stop without touching anything.

    If it is too near to something already, coming no nearer is enough.
    """
    units = around.units
    wanted = around.k.stop_clearance
    enough = pose_clearance(motion.pose, around, wanted) - 1e-3
    hold = around.k.hold_periods
    hold_steps = count_steps(hold)
    slowing = hold + units.speed / units.braking + 8.0 * units.lag + ARC_STEP

    # First the command, then a full stop.
    for step in range(count_steps(slowing)):
        is_holding = step < hold_steps
        if is_holding:
            motion = advance_arc(motion, linear, angular, units.acceleration, around)
        else:
            motion = advance_arc(motion, 0.0, 0.0, units.braking, around)
        if pose_clearance(motion.pose, around, wanted) < enough:
            return False

        # At rest, or as good as that.
        if not is_holding and abs(motion.linear) < 0.01 and abs(motion.angular) < 0.05:
            break
    return True


@loop
def escape(motion: Motion, around: Situation) -> tuple[float, float]:
    """Back off slowly, or turn, towards more clearance, because no velocity is admissible."""
    most_free = -1.0
    chosen = (0.0, 0.0)

    for linear in (0.0, -0.2 * around.units.speed, 0.2 * around.units.speed):
        for angular in (0.0, -0.4 * around.units.turning, 0.4 * around.units.turning):
            # Where that leads to within 0.3 s, along a straight line.
            x, y, theta = motion.pose
            theta += 0.3 * angular
            x += 0.3 * linear * math.cos(theta)
            y += 0.3 * linear * math.sin(theta)
            free = pose_clearance((x, y, theta), around, around.units.radius)
            if free > most_free + 1e-3:
                most_free = free
                chosen = (linear, angular)
    return chosen


@jit
def pose_clearance(pose: Pose, around: Situation, limit: float) -> float:
    """Clearance of the footprint from obstacles, at most `limit` [m]."""
    return footprint_clearance(pose, around.points, around.footprint, limit)


@loop
def movers_clearance(motion: Motion, time: float, around: Situation, limit: float) -> float:
    """Clearance of the footprint from where movers are after some time, at most `limit` [m]."""
    x, y, theta = motion.pose
    cos = math.cos(theta)
    sin = math.sin(theta)
    for mover in around.movers:
        dx = mover[X] + time * mover[RATE_X] - x
        dy = mover[Y] + time * mover[RATE_Y] - y
        reach = around.footprint.outer + mover[RADIUS] + limit
        if dx * dx + dy * dy < reach * reach:
            along = dx * cos + dy * sin
            gap = polygon_distance(along, dy * cos - dx * sin, around.footprint.sides)
            limit = min(limit, max(gap - mover[RADIUS], 0.0))
    return limit
