"""The dynamic window approach: Fox, Burgard & Thrun, "The dynamic window approach to collision
avoidance", IEEE Robotics & Automation Magazine 4 (1997).

Of the velocities that the robot can reach within a step, those are admissible after which it can
still stop before it touches anything. Among them the best is chosen by progress to the goal and
clearance. Progress is that of a navigation function on the map kept from the scans, as in the
global dynamic window approach (Brock & Khatib, ICRA 1999), because the heading towards the goal
alone ends in the first dead end. Arcs have the robot's acceleration limits and motor lag.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.jit import loop
from acsar_gym.policies.setting import Seen, Setting
from acsar_gym.safety.limiter import limits
from acsar_gym.tasks.base import Floats

from .geometry import clearance
from .mapped import MappedPolicy
from .motion import Pose
from .potential import interpolated

LINEAR, ANGULAR = 9, 25
"""How many linear and angular velocities of the window are tried."""
HORIZON = 1.5
"""How far ahead an arc is scored [s]."""
TURNS = 0.6
"""How long the robot turns on an arc before it goes straight [s]."""
STEP = 0.05
"""Step of the predicted arcs [s]."""
HELD = 0.2
"""How long a velocity is kept before the robot brakes, when it is checked for collisions [s]."""
NOSE = 0.25
"""The navigation function counts this far ahead of the robot, so that its heading matters [m]."""
SAFE = 0.03
"""Least clearance of the footprint on the way to a stop [m]."""
SOFT, FADES = 0.15, 0.06
"""Cost of a second without clearance [m/s], and the clearance where it has fallen to 1/e [m]."""
STRONG = 3.0
"""Deceleration of a full stop, which the command limits don't slow down [m/s^2]."""


class Dwa(MappedPolicy):
    """Samples the velocities that can be reached within a step, and keeps able to stop."""

    name = "dwa"

    def equip(self, setting: Setting) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        config = setting.config
        forward = limits(config.linear_limits, config.max_linear)
        turning = limits(config.angular_limits, config.max_angular)
        lag = sum(config.motor.of_wheel(wheel).time_constant for wheel in range(4)) / 4.0
        self._model = (
            min(forward.max_acceleration, 1e3),
            min(turning.max_acceleration, 1e3),
            1.0 - math.exp(-STEP / lag) if lag > 0.0 else 1.0,
        )

    def decide(self, pose: Pose, goal: tuple[float, float], seen: Seen) -> tuple[float, float]:
        """Choose the best admissible velocity [m/s, rad/s]; stops where there is none."""
        config = self.setting.config
        window = self._window(config.max_linear, config.max_angular)
        near = self.obstacles(pose, config.max_linear * HORIZON + self.outer + 0.3)
        state = (*pose, seen.linear, seen.angular, *self.sent)
        field = (self.plan.values, self.plan.x, self.plan.y)
        target = (*goal, 0.9 * self.setting.tolerance)
        body = (self.sides, self.outer)
        scores = scored(window, state, self._model, near, body, field, target)
        best = int(scores.argmin())
        if not math.isfinite(scores[best]):
            return self._escape(near, state)
        return float(window[best, 0]), float(window[best, 1])

    def _window(self, fastest: float, turning: float) -> Floats:
        """(n, 2): velocities that can be reached in a step, and standing still."""
        linear, angular = self._model[0] * self.setting.period, self._model[1] * self.setting.period
        v = np.clip(self.sent[0] + np.linspace(-linear, linear, LINEAR), 0.0, fastest)
        w = np.clip(self.sent[1] + np.linspace(-angular, angular, ANGULAR), -turning, turning)
        pairs = np.stack(np.meshgrid(np.unique(np.append(v, 0.0)), np.unique(np.append(w, 0.0))))
        window: Floats = pairs.reshape(2, -1).T
        return window

    def _escape(self, near: Floats, state: tuple[float, ...]) -> tuple[float, float]:
        """Back off slowly, or turn, to where there is more clearance; nothing is admissible."""
        x, y, theta = state[:3]
        best, chosen = -1.0, (0.0, 0.0)
        for linear in (0.0, -0.1, 0.1):
            for angular in (0.0, -0.6, 0.6):
                heading = theta + 0.3 * angular
                ahead = 0.3 * linear
                there = x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading
                free = clearance(*there, near, self.sides, self.outer, 0.2)
                if free > best + 1e-3:
                    best, chosen = free, (linear, angular)
        return chosen


@loop
def scored(
    window: Floats,
    state: tuple[float, float, float, float, float, float, float],
    model: tuple[float, float, float],
    near: Floats,
    body: tuple[Floats, float],
    field: tuple[Floats, float, float],
    target: tuple[float, float, float],
) -> Floats:
    """Score velocities; less is better.

    Args:
        window: (n, 2), linear [m/s] and angular [rad/s].
        state: pose, twist and last command.
        model: greatest linear [m/s^2] and angular acceleration [rad/s^2], and the share of the
            difference to the command by which the twist changes in a STEP.
        near: (n, 2), obstacles in the frame of the pose [m].
        body: the footprint's sides, and the radius of the disc around it [m].
        field: the navigation function: values, x and y of its first cell.
        target: the goal, and its radius [m].

    Returns:
        (n,): the scores, in equivalent metres; infinite where a velocity isn't admissible.
    """
    scores, (sides, outer) = np.empty(len(window)), body
    for n in range(len(window)):
        command = (window[n, 0], window[n, 1])
        if not stops(command, state, model, near, sides, outer):
            scores[n] = np.inf
            continue
        x, y, theta, v, w, sent_v, sent_w = state
        cost, arrived = 0.0, False
        for step in range(int(HORIZON / STEP + 0.5)):
            turning = command[1] if step * STEP < TURNS else 0.0
            sent_v += min(max(command[0] - sent_v, -model[0] * STEP), model[0] * STEP)
            sent_w += min(max(turning - sent_w, -model[1] * STEP), model[1] * STEP)
            v += model[2] * (sent_v - v)
            w += model[2] * (sent_w - w)
            theta += w * STEP
            x += v * STEP * math.cos(theta)
            y += v * STEP * math.sin(theta)
            if step % 2 == 1:
                free = clearance(x, y, theta, near, sides, outer, 0.25)
                cost += 2.0 * STEP * SOFT * math.exp(-free / FADES)
                if free < SAFE:
                    cost += 0.3 * (1.0 - step * STEP / HORIZON)
                    break
                dx, dy = target[0] - x, target[1] - y
                if dx * dx + dy * dy < target[2] * target[2]:
                    arrived = True
                    cost -= 1.0 - step * STEP / HORIZON
                    break
        nose_x, nose_y = x + NOSE * math.cos(theta), y + NOSE * math.sin(theta)
        left = interpolated(field[0], field[1], field[2], nose_x, nose_y)
        scores[n] = cost if arrived else cost + left
    return scores


@loop
def stops(
    command: tuple[float, float],
    state: tuple[float, float, float, float, float, float, float],
    model: tuple[float, float, float],
    near: Floats,
    sides: Floats,
    outer: float,
) -> bool:
    """Whether the robot can obey a command for a while, and then stop without touching anything.

    Where it is too near to something already, coming no nearer is enough.
    """
    x, y, theta, v, w, sent_v, sent_w = state
    least = min(clearance(x, y, theta, near, sides, outer, SAFE) - 1e-3, SAFE)
    for step in range(int(1.0 / STEP)):
        held = step * STEP < HELD
        limit = model[0] if held else STRONG
        goal_v, goal_w = (command[0], command[1]) if held else (0.0, 0.0)
        sent_v += min(max(goal_v - sent_v, -limit * STEP), limit * STEP)
        sent_w += min(max(goal_w - sent_w, -model[1] * STEP), model[1] * STEP)
        v += model[2] * (sent_v - v)
        w += model[2] * (sent_w - w)
        theta += w * STEP
        x += v * STEP * math.cos(theta)
        y += v * STEP * math.sin(theta)
        if clearance(x, y, theta, near, sides, outer, SAFE) < least:
            return False
        if not held and abs(v) < 0.01 and abs(w) < 0.05:
            break
    return True
