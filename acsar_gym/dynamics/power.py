"""Mechanical power of a robot's motors, by the tyre forces of `dynamics.model`."""

from __future__ import annotations

import math
from typing import Any

from acsar_gym.dynamics.model import Velocity
from acsar_gym.jit import loop
from acsar_gym.protocol import Speeds


@loop
def motor_power(cos: float, sin: float, velocity: Velocity, wheels: Speeds, physics: Any) -> float:
    """Compute the power that the motors give to the ground at this moment.

    P = sum over wheels of max(0, F_i r_i w_i), in which r_i w_i is the speed of the wheel's
    surface and F_i = -D_i s_x the force of its tyre along the rolling direction, with D_i and the
    slip (s_x, s_y) of `dynamics.model`. A wheel that is pushed by the ground brakes; its motor
    recovers nothing. Losses inside the motors are not known.

    Args:
        cos: of the heading.
        sin: of the heading.
        velocity: vx, vy [m/s] in the world frame, yaw rate [rad/s].
        wheels: speeds of the four wheels [rad/s].
        physics: of the robot, a record of `Physics`.

    Returns:
        The power [W].
    """
    own = physics[0]
    vx, vy, rate = velocity
    ahead, aside = cos * vx + sin * vy, cos * vy - sin * vx
    power = 0.0
    for k in range(4):
        on_right, in_front = k in (0, 3), k < 2
        rim = wheels[k] * (own.right_radius if on_right else own.left_radius)
        slip = ahead + (rate if on_right else -rate) * own.half_track - rim
        across = aside + (rate if in_front else -rate) * own.half_wheelbase
        size = max(math.sqrt(slip * slip + own.kappa * across * across), own.slip_speed)
        power += max(0.0, -own.grip * slip / size * rim)
    return power
