"""Motor and tyre model of a skid-steer robot on a flat floor, as pure scalar functions.

The planar state is (vx, vy [m/s], yaw rate [rad/s]) in the body frame; wheels are in the order
front_right, front_left, rear_left, rear_right. Tyres are isotropic Coulomb friction under equal
loads, smoothed below a small slip speed. That law is stiff, so it is solved implicitly: backward
Euler with secant friction, a symmetric 3 x 3 system per fixed-point round. In a steady turn the
exact solution turns 1 + (wheelbase / wheel_separation)^2 times slower than the differential-drive
formula says.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.jit import COMPILED, jit, leading
from acsar_gym.protocol import Speeds

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
ROUNDS = 3
"""Fixed-point iterations for the secant friction."""

Velocity = tuple[float, float, float]
"""vx, vy [m/s] and yaw rate [rad/s]."""


class Physics(NamedTuple):
    """The numbers of one robot that its physics needs; SI units, wheels a to d in wheel order.

    Any of them may vary from episode to episode; see `randomization`.
    """

    radius: float
    """Wheel radius [m]."""
    half_wheelbase: float
    """Half the distance between the front and rear axles [m]."""
    half_track: float
    """Half the distance between the left and right wheels [m]."""
    mass: float
    """Mass of the robot [kg]."""
    yaw_inertia: float
    """Moment of inertia about the vertical axis [kg m^2]."""
    grip: float
    """Greatest friction force of one tyre [N]."""
    slip_speed: float
    """Below this slip speed friction grows linearly with it [m/s]."""
    max_speed: float
    """Top speed of a motor [rad/s]."""
    deadband: float
    """Set points below this don't turn a wheel [rad/s]."""
    blend_a: float
    """Share of the difference to its set point by which a wheel's speed changes in a firmware
    loop."""
    blend_b: float
    blend_c: float
    blend_d: float
    gain_a: float
    """Factor from a wheel's set point to its speed."""
    gain_b: float
    gain_c: float
    gain_d: float
    latency_loops: float
    """Delay of commands and of feedback on top of the wire's own [firmware loops]."""
    feedback_loops: float
    """Period of feedback lines [firmware loops]."""


SIZE = len(Physics._fields)
Numbers = NDArray[np.float64] | Sequence[float]


@jit
def physics_of(numbers: Numbers) -> Physics:
    """Make a Physics of an array of its numbers."""
    return Physics(*leading(numbers, SIZE))


@jit
def physics_at(rows: NDArray[np.float64], i: int) -> Physics:
    """Make the Physics of robot i from column i of an array with a row for each number.

    The index is unsigned so that compiled code needs no check for negative ones, and can be
    vectorized.
    """
    k = np.uintp(i)
    return Physics(
        rows[0, k],
        rows[1, k],
        rows[2, k],
        rows[3, k],
        rows[4, k],
        rows[5, k],
        rows[6, k],
        rows[7, k],
        rows[8, k],
        rows[9, k],
        rows[10, k],
        rows[11, k],
        rows[12, k],
        rows[13, k],
        rows[14, k],
        rows[15, k],
        rows[16, k],
        rows[17, k],
        rows[18, k],
    )


def numbers_of(own: Physics) -> Numbers:
    """Convert a Physics to what `robot_step` takes: an array with numba, else a tuple (faster)."""
    return np.array(own, np.float64) if COMPILED else tuple(own)


def substep(config: RobotConfig) -> float:
    """Period of the firmware loop, which is also the step of the physics [s]."""
    return 1.0 / config.firmware.loop_rate


def wire_loops(config: RobotConfig) -> int:
    """Firmware loops from sending a line until it is used, without extra latency."""
    line = (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate
    return math.ceil((line + config.firmware.processing_time) / substep(config) - 1e-6)


def physics(config: RobotConfig) -> Physics:
    """Compute the physics of a robot from its configuration."""
    body, motor = config.body, config.motor
    dt, lag = substep(config), motor.of_wheel(0).time_constant
    blend = 1.0 - math.exp(-dt / lag) if lag > 0.0 else 1.0
    return Physics(
        radius=config.wheel_radius,
        half_wheelbase=config.wheelbase / 2.0,
        half_track=config.wheel_separation / 2.0,
        mass=body.mass,
        yaw_inertia=body.mass * (body.length**2 + body.width**2) / 12.0,
        grip=body.friction * body.mass * GRAVITY / 4.0,
        slip_speed=body.slip_speed,
        max_speed=motor.max_speed,
        deadband=motor.of_wheel(0).deadband,
        blend_a=blend,
        blend_b=blend,
        blend_c=blend,
        blend_d=blend,
        gain_a=1.0,
        gain_b=1.0,
        gain_c=1.0,
        gain_d=1.0,
        latency_loops=0.0,
        feedback_loops=config.firmware.loop_rate / config.feedback_rate,
    )


@jit
def wheel_speed(speed: float, set_point: float, gain: float, blend: float, own: Physics) -> float:
    """Compute a wheel's speed one substep later: gain, deadband, saturation, first-order lag.

    Args:
        speed: of the wheel [rad/s].
        set_point: of the firmware [rad/s].
        gain: of this wheel.
        blend: of this wheel.
        own: physics of the robot.
    """
    set_point *= gain
    if abs(set_point) < own.deadband:
        set_point = 0.0
    set_point = min(max(set_point, -own.max_speed), own.max_speed)
    speed += blend * (set_point - speed)
    return 0.0 if set_point == 0.0 and abs(speed) < 1e-3 else speed


@jit
def towards(value: float, target: float, step: float) -> float:
    """Move a value towards a target by at most `step`."""
    return min(max(target, value - step), value + step)


@jit
def ramped(set_points: Speeds, targets: Speeds, step: float) -> Speeds:
    """Move four set points [rad/s] towards their targets by at most `step`."""
    return (
        towards(set_points[0], targets[0], step),
        towards(set_points[1], targets[1], step),
        towards(set_points[2], targets[2], step),
        towards(set_points[3], targets[3], step),
    )


@jit
def tyre_step(
    vx: float,
    vy: float,
    yaw_rate: float,
    wheels: Speeds,
    own: Physics,
    dt: float,
) -> Velocity:
    """Velocity (body frame) one substep later, under the forces of four tyres; wheels in [rad/s].

    Solves m (v' - v) / dt = sum F_i(v') with F_i = -D_i slip_i(v') and D_i = grip / |slip_i|, in
    which slip_i is the velocity of contact patch i over the ground.
    """
    a, b = own.half_wheelbase, own.half_track
    inertia, yaw_inertia = own.mass / dt, own.yaw_inertia / dt
    rim_a, rim_b = wheels[0] * own.radius, wheels[1] * own.radius
    rim_c, rim_d = wheels[2] * own.radius, wheels[3] * own.radius
    nx, ny, nw = vx, vy, yaw_rate
    floor = own.slip_speed * own.slip_speed
    for _ in range(ROUNDS):
        right, left = nx + nw * b, nx - nw * b
        front, rear = ny + nw * a, ny - nw * a
        d_a = own.grip / math.sqrt(max((right - rim_a) ** 2 + front**2, floor))
        d_b = own.grip / math.sqrt(max((left - rim_b) ** 2 + front**2, floor))
        d_c = own.grip / math.sqrt(max((left - rim_c) ** 2 + rear**2, floor))
        d_d = own.grip / math.sqrt(max((right - rim_d) ** 2 + rear**2, floor))
        total = d_a + d_b + d_c + d_d
        # Symmetric system [[k, 0, p], [0, k, q], [p, q, s]] (nx, ny, nw) = (fx, fy, fw).
        k = inertia + total
        p = b * (d_a + d_d - d_b - d_c)
        q = a * (d_a + d_b - d_c - d_d)
        s = yaw_inertia + (a * a + b * b) * total
        fx = inertia * vx + d_a * rim_a + d_b * rim_b + d_c * rim_c + d_d * rim_d
        fy = inertia * vy
        fw = yaw_inertia * yaw_rate + b * (d_a * rim_a + d_d * rim_d - d_b * rim_b - d_c * rim_c)
        free = 1.0 / k
        nw = (fw - (p * fx + q * fy) * free) / (s - (p * p + q * q) * free)
        nx = (fx - p * nw) * free
        ny = (fy - q * nw) * free
    return nx, ny, nw


@jit
def robot_step(
    cos: float,
    sin: float,
    velocity: Velocity,
    wheels: Speeds,
    angles: Speeds,
    set_points: Speeds,
    numbers: Numbers,
    dt: float,
) -> tuple[Velocity, Speeds, Speeds]:
    """Advance motors, then tyres, by one substep.

    Args:
        cos: of the heading.
        sin: of the heading.
        velocity: vx, vy [m/s] in the world frame, yaw rate [rad/s].
        wheels: speeds of the four wheels [rad/s].
        angles: turned by the four wheels [rad].
        set_points: of the firmware [rad/s].
        numbers: of the robot's `Physics`, see `numbers_of`.
        dt: substep [s].

    Returns:
        The new velocity, wheel speeds and wheel angles.
    """
    own = physics_of(numbers)
    a = wheel_speed(wheels[0], set_points[0], own.gain_a, own.blend_a, own)
    b = wheel_speed(wheels[1], set_points[1], own.gain_b, own.blend_b, own)
    c = wheel_speed(wheels[2], set_points[2], own.gain_c, own.blend_c, own)
    d = wheel_speed(wheels[3], set_points[3], own.gain_d, own.blend_d, own)
    vx, vy, rate = velocity
    forward, left, rate = tyre_step(
        cos * vx + sin * vy, cos * vy - sin * vx, rate, (a, b, c, d), own, dt
    )
    return (
        (cos * forward - sin * left, sin * forward + cos * left, rate),
        (a, b, c, d),
        (angles[0] + a * dt, angles[1] + b * dt, angles[2] + c * dt, angles[3] + d * dt),
    )


def closed_form_yaw_rate(speeds: Speeds, config: RobotConfig) -> float:
    """Yaw rate [rad/s] of a steady turn with constant wheel speeds [rad/s], neglecting inertia."""
    right, left = (speeds[0] + speeds[3]) / 2.0, (speeds[1] + speeds[2]) / 2.0
    plain = (right - left) * config.wheel_radius / config.wheel_separation
    return plain / (1.0 + (config.wheelbase / config.wheel_separation) ** 2)
