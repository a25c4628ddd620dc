"""The dynamic window approach.

Fox, Burgard & Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics &
Automation Magazine 4 (1997).

Of the velocities that the robot can reach within a step, those are admissible after which it can
still stop before it touches anything. Among them the best is chosen by progress to the goal and
clearance. Progress is that of a navigation function on the map kept from the scans, as in the
global dynamic window approach (Brock & Khatib, ICRA 1999), because the heading towards the goal
alone ends in the first dead end. Arcs have the robot's acceleration limits and motor lag.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.safety.rules import read_limits
from acsar_gym.tasks.base import Floats
from acsar_gym.tools.baselines.mapping import (
    MappedPolicy,
    MotionState,
    Pose,
    Surroundings,
    in_goal,
    pose_clearance,
    way_left,
)
from acsar_gym.tools.policies.base import DecodedObservation, PolicyContext

LINEAR_SAMPLES, ANGULAR_SAMPLES = 9, 25
"""How many linear and angular velocities of the window are tried."""
REVERSE_SHARE = 0.4
"""Greatest speed backwards, out of dead ends, as a share of the greatest one ahead."""
ARC_SECONDS = 1.5
"""How far ahead an arc is scored [s]."""
TURN_SECONDS = 0.6
"""How long the robot turns on an arc before it goes straight [s]."""
ARC_STEP = 0.05
"""Step of the predicted arcs [s]."""
HOLD_SECONDS = 0.2
"""How long a velocity is kept before the robot brakes, when it is checked for collisions [s]."""
ARC_NOSE = 0.25
"""The navigation function counts this far ahead of the robot, so that its heading matters [m]."""
STOP_CLEARANCE = 0.03
"""Least clearance of the footprint on the way to a stop [m]."""
NEAR_COST, NEAR_FADE = 0.15, 0.06
"""Cost of a second without clearance [m/s], and the clearance where it has fallen to 1/e [m]."""
BLOCKED_COST = 0.3
"""Cost of an arc that comes too near to something, times the share of it that is left [m]."""
STILL_STEPS, ALIGNED_BEARING = 5, 0.3
"""After so many decisions to stand still it turns to the plan, up to this bearing [rad]."""
STOP_DECELERATION = 3.0
"""Deceleration of a full stop, which the command limits don't slow down [m/s^2]."""

ArcModel = tuple[float, float, float]
"""Greatest linear [m/s^2] and angular acceleration [rad/s^2], and the share of the difference to
the command by which the twist changes in a STEP."""


class Dwa(MappedPolicy):
    """Samples the velocities that can be reached within a step, and keeps able to stop."""

    name = "dwa"
    _still = 0

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        config = setting.config
        forward = read_limits(config.linear_limits, config.max_linear)
        turning = read_limits(config.angular_limits, config.max_angular)
        lag = sum(config.motor.of_wheel(wheel).time_constant for wheel in range(4)) / 4.0
        self._model = (
            min(forward.max_acceleration, 1e3),
            min(turning.max_acceleration, 1e3),
            1.0 - math.exp(-ARC_STEP / lag) if lag > 0.0 else 1.0,
        )

    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Choose the best admissible velocity [m/s, rad/s]; stops where there is none."""
        config = self.setting.config
        window = self._window(config.max_linear, config.max_angular)
        around = self.around(
            pose, config.max_linear * ARC_SECONDS, goal, 0.9 * self.setting.tolerance
        )
        state = (*pose, seen.linear, seen.angular, *self.sent)
        scores = score_window(window, state, self._model, around)
        best = int(scores.argmin())
        if not math.isfinite(scores[best]):
            return self._escape(around, state)
        linear, angular = window[best].tolist()
        idle = abs(linear) < 0.03 and abs(angular) < 0.15
        self._still = self._still + 1 if idle or self._still > STILL_STEPS else 0
        if self._still > STILL_STEPS:
            return self._align(pose, goal, state, around) or (linear, angular)
        return linear, angular

    def reset(self) -> None:
        """Forget map, motion and decisions."""
        super().reset()
        self._still = 0

    def _align(
        self, pose: Pose, goal: tuple[float, float], state: MotionState, around: Surroundings
    ) -> tuple[float, float] | None:
        """Turn towards the plan; None once it lies ahead, or where there is no room to turn."""
        x, y = self.carrot(pose, goal, 0.4)
        bearing = math.atan2(y, x)
        turn = math.copysign(0.5 * self.setting.config.max_angular, bearing)
        if abs(bearing) < ALIGNED_BEARING or not can_stop(0.0, turn, state, self._model, around):
            self._still = 0
            return None
        return 0.0, turn

    def _window(self, fastest: float, turning: float) -> Floats:
        """(n, 2): velocities that can be reached in a step, and standing still."""
        linear, angular = self._model[0] * self.setting.period, self._model[1] * self.setting.period
        v = self.sent[0] + np.linspace(-linear, linear, LINEAR_SAMPLES)
        v = np.clip(v, -REVERSE_SHARE * fastest, fastest)
        w = np.clip(
            self.sent[1] + np.linspace(-angular, angular, ANGULAR_SAMPLES), -turning, turning
        )
        pairs = np.stack(np.meshgrid(np.unique(np.append(v, 0.0)), np.unique(np.append(w, 0.0))))
        window: Floats = pairs.reshape(2, -1).T
        return window

    def _escape(self, around: Surroundings, state: MotionState) -> tuple[float, float]:
        """Back off slowly, or turn, to where there is more clearance; nothing is admissible."""
        x, y, theta = state[:3]
        best, chosen = -1.0, (0.0, 0.0)
        for linear in (0.0, -0.1, 0.1):
            for angular in (0.0, -0.6, 0.6):
                heading = theta + 0.3 * angular
                ahead = 0.3 * linear
                there = x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading
                free = pose_clearance(*there, around, 0.2)
                if free > best + 1e-3:
                    best, chosen = free, (linear, angular)
        return chosen


@jit
def advance_arc(
    state: MotionState, linear: float, angular: float, brake: float, model: ArcModel
) -> MotionState:
    """Predict the state a STEP later.

    Args:
        state: now.
        linear: command [m/s].
        angular: command [rad/s].
        brake: greatest linear acceleration [m/s^2].
        model: of the robot.
    """
    x, y, theta, v, w, sent_v, sent_w = state
    sent_v += min(max(linear - sent_v, -brake * ARC_STEP), brake * ARC_STEP)
    sent_w += min(max(angular - sent_w, -model[1] * ARC_STEP), model[1] * ARC_STEP)
    v += model[2] * (sent_v - v)
    w += model[2] * (sent_w - w)
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

    Args:
        window: (n, 2), linear [m/s] and angular [rad/s].
        state: now.
        model: of the robot.
        around: of the robot.

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
    cost, steps = 0.0, int(ARC_SECONDS / ARC_STEP + 0.5)
    for step in range(steps):
        turning = angular if step * ARC_STEP < TURN_SECONDS else 0.0
        state = advance_arc(state, linear, turning, model[0], model)
        if step % 2 == 0:
            continue
        free = pose_clearance(state[0], state[1], state[2], around, 0.25)
        cost += 2.0 * ARC_STEP * NEAR_COST * math.exp(-free / NEAR_FADE)
        left = 1.0 - step / steps
        if free < STOP_CLEARANCE:
            cost += BLOCKED_COST * left
            break
        if in_goal(state[0], state[1], around):
            return cost - left
    return cost + way_left(state[0], state[1], state[2], ARC_NOSE, around)


@loop
def can_stop(
    linear: float, angular: float, state: MotionState, model: ArcModel, around: Surroundings
) -> bool:
    """Whether the robot can obey a command for a while, and then stop without touching anything.

    Where it is too near to something already, coming no nearer is enough.
    """
    least = pose_clearance(state[0], state[1], state[2], around, STOP_CLEARANCE) - 1e-3
    for step in range(int(1.0 / ARC_STEP)):
        if step * ARC_STEP < HOLD_SECONDS:
            state = advance_arc(state, linear, angular, model[0], model)
        else:
            state = advance_arc(state, 0.0, 0.0, STOP_DECELERATION, model)
        if pose_clearance(state[0], state[1], state[2], around, STOP_CLEARANCE) < least:
            return False
        if step * ARC_STEP >= HOLD_SECONDS and abs(state[3]) < 0.01 and abs(state[4]) < 0.05:
            break
    return True
